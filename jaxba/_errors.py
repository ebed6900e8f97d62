"""The error that a user can act on: what is wrong, with which value, and what to do next."""


class JaxbaError(ValueError):
    """Bad input; the message names the file or field, the value and the cure."""
