"""The judge's subcommands of ``wearline``."""

from wearline_judge.commands.files import JUDGE, TEMPLATE
from wearline_judge.commands.recipe import RECIPE
from wearline_judge.commands.replay import REPLAY
from wearline_judge.commands.verify import VERIFY

__all__ = ["JUDGE", "RECIPE", "REPLAY", "TEMPLATE", "VERIFY"]
