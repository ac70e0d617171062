"""The command that the user typed, for messages that name the next command."""

import os
import shlex
from pathlib import Path

COMMAND_VARIABLE = "AVATAR_COMMAND"
"""Environment variable with the command's name; the console command sets it for itself and its child processes."""

MODULE_COMMAND = "python -m stages"


def format_command(*arguments: str | Path) -> str:
    """Format a complete command line: the command that is running, followed by `arguments` in shell quotes."""
    words = (shlex.quote(str(argument)) for argument in arguments)
    return " ".join([os.environ.get(COMMAND_VARIABLE, MODULE_COMMAND), *words])


def rerun_command(stage: str, folder: Path) -> str:
    """Format the command that makes the folder of a stage anew; folder: of the stage, in that of its run."""
    return format_command(stage, folder.parent, "--force")
