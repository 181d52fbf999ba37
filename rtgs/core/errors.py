"""The error type for what a user can mend: printed by the command line as one message, without a traceback."""


class RtgsError(ValueError):
    """Something about the input, the config or the disk is wrong; the message says what, where and what to do."""
