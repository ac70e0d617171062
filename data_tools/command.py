"""Commands of `data_tools`: what the user can mend becomes one sentence and exit status 2."""

import sys
from collections.abc import Callable, Sequence

from pipeline.core.cli import USER_ERROR
from pipeline.core.errors import UserError, os_error_sentence
from pipeline.core.runner import INTERRUPTED


def run_command(work: Callable[[Sequence[str]], None], argv: Sequence[str]) -> int:
    """Run a command with its arguments; return the exit status. Faults of the program stay loud."""
    try:
        work(argv)
    except UserError as error:
        sentence: str | None = str(error)
    except OSError as error:
        sentence = os_error_sentence(error)
        if sentence is None:
            raise
    except KeyboardInterrupt:
        print("interrupted: run the same command again", file=sys.stderr)
        return INTERRUPTED
    else:
        return 0
    print(f"error: {sentence}", file=sys.stderr)
    return USER_ERROR
