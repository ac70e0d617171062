"""Hostile files: every reader of user files on damaged files and on files made to harm."""
