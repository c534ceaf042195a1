"""The one exception that Marotte shows to people."""


class MarotteError(Exception):
    """Something that the user can act on.

    Its text is complete by itself: what is wrong, where (file and key, port, command), and what was expected. The
    command line prints it as one message and exits; it never shows a traceback. Raise a subclass where a caller has to
    tell cases apart.
    """
