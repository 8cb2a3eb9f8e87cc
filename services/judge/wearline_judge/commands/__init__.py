"""The judge's subcommands of ``wearline``."""

from wearline_judge.commands.backup import BACKUP, RESTORE
from wearline_judge.commands.capability import CAPABILITY
from wearline_judge.commands.export import EXPORT, IMPORT
from wearline_judge.commands.files import JUDGE, TEMPLATE
from wearline_judge.commands.recipe import RECIPE
from wearline_judge.commands.rejudge import REJUDGE
from wearline_judge.commands.replay import REPLAY
from wearline_judge.commands.verify import VERIFY

__all__ = [
    "BACKUP", "CAPABILITY", "EXPORT", "IMPORT", "JUDGE", "RECIPE", "REJUDGE", "REPLAY", "RESTORE", "TEMPLATE", "VERIFY",
]  # fmt: skip
