"""What the person at the terminal can mend, in one sentence."""

import errno

ERRNO_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space, then run the same command again",
    errno.EDQUOT: "the disk quota is used up: free some space, then run the same command again",
    errno.EACCES: "there is no permission: change the rights, or choose another folder with --run",
    errno.EPERM: "there is no permission: change the rights, or choose another folder with --run",
    errno.ENOTDIR: "a part of that path is a file: choose another folder with --run",
    errno.EROFS: "the disk is read-only: choose another folder with --run",
}


class UserError(Exception):
    """Something the user can mend: bad input, a wrong configuration value, a full disk.

    The message is one sentence: what is wrong, where (file, frame or key), and what to do next (often a command).
    The command line prints it as ``error: <message>`` and exits with status 2, without a traceback.
    """


def format_os_error(error: OSError) -> str | None:
    """The sentence for a system error that the user can mend; None for one that is a fault of the program."""
    remedy = ERRNO_REMEDIES.get(error.errno or 0)
    return remedy and f"{error.filename or 'the run folder'} cannot be written or read, {remedy}"
