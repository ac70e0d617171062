"""Commands in messages, as the user can copy them into the shell in which the program was started."""

import os
import shlex
import sys
from pathlib import Path

COMMAND_VARIABLE = "AVATAR_COMMAND"
"""Environment variable with the command's name; the console command sets it for itself and its child processes."""

PIPELINE_MODULE = "stages"


def program_name() -> str:
    """Return the command that runs the pipeline: that of the environment, or the module in this interpreter."""
    return os.environ.get(COMMAND_VARIABLE) or format_module_command(PIPELINE_MODULE)


def format_command(*arguments: str | Path) -> str:
    """Format a complete command line: the command that is running, followed by `arguments` in shell quotes."""
    return " ".join([program_name(), *_quoted(*arguments)])


def format_module_command(module: str, *arguments: str | Path) -> str:
    """Format the command line that runs a module in this interpreter, which has the packages that the module needs.

    The interpreter is named relative to the working directory if it lies in it, as that of a checkout does.
    """
    interpreter, here = Path(sys.executable or "python"), Path.cwd()
    if interpreter.is_relative_to(here):
        interpreter = interpreter.relative_to(here)
    return " ".join(_quoted(interpreter, "-m", module, *arguments))


def rerun_command(stage: str, folder: Path) -> str:
    """Format the command that makes the folder of a stage anew; folder: of the stage, in that of its run."""
    return format_command(stage, folder.parent, "--force")


def _quoted(*arguments: str | Path) -> list[str]:
    return [shlex.quote(str(argument)) for argument in arguments]
