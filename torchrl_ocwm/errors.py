"""Errors that whoever runs a recipe can mend."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user can mend; the message says what is wrong and how. Recipes show it on one line.

    All other errors are ours, and show their traceback.
    """


class MissingPackageError(UserError, ModuleNotFoundError):
    """A package that is not installed; the message says what installs it."""
