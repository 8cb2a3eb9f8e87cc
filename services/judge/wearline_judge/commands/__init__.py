"""The judge's subcommands of ``wearline``."""

from wearline_judge.commands.files import JUDGE, TEMPLATE
from wearline_judge.commands.recipe import RECIPE
from wearline_judge.commands.replay import REPLAY

__all__ = ["JUDGE", "RECIPE", "REPLAY", "TEMPLATE"]
