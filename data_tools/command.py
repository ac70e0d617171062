"""Run a command of `data_tools`: errors that the user can fix become one message and exit status 2."""

import sys
from collections.abc import Callable, Sequence

from pipeline.core.errors import EXIT_USER_ERROR, UserError, format_os_error
from pipeline.core.runner import EXIT_INTERRUPTED


def run_command(command: Callable[[Sequence[str]], None], argv: Sequence[str]) -> int:
    """Run a command and return its exit status; unexpected errors propagate."""
    try:
        command(argv)
    except UserError as error:
        message: str | None = str(error)
    except OSError as error:
        message = format_os_error(error)
        if message is None:
            raise
    except KeyboardInterrupt:
        print("interrupted: run the same command again", file=sys.stderr)
        return EXIT_INTERRUPTED
    else:
        return 0
    print(f"error: {message}", file=sys.stderr)
    return EXIT_USER_ERROR
