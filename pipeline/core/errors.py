"""Errors that the user can correct, each in one sentence."""

import errno

EXIT_USER_ERROR = 2
"""Exit status of a command after a `UserError`, or a system error that the user can correct."""

ERRNO_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space, then run the same command again",
    errno.EDQUOT: "the disk quota is exceeded: free some space, then run the same command again",
    errno.EACCES: "permission was denied: change the permissions, or choose another folder",
    errno.EPERM: "permission was denied: change the permissions, or choose another folder",
    errno.ENOTDIR: "a part of this path is a file: choose another folder",
    errno.EISDIR: "it is a folder: choose a file",
    errno.EROFS: "the disk is read-only: choose another folder",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter name",
}


class UserError(Exception):
    """Error that the user can correct: bad input, an invalid configuration value, a full disk.

    The message is one sentence: what is wrong, where (file, frame or key), and what to do next (often a command).
    The command line prints it as ``error: <message>`` and exits with status 2, without a traceback.
    """


def format_os_error(error: OSError) -> str | None:
    """Describe a system error that the user can correct; return None for one that is a fault of the program."""
    remedy = ERRNO_REMEDIES.get(error.errno or 0)
    return remedy and f"{error.filename or 'the run folder'} cannot be read or written, {remedy}"
