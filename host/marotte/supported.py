"""What the file format defines and this version does not perform yet: the one list of it.

The readers accept and check these things, then ask `Document.not_yet` about each one that a file uses, so that nothing in
a file is ever ignored silently. Performing a feature means deleting its entry here.
"""

NOT_YET = {
    "gains": "a band gain other than 1",
    "kalman": 'predict = "kalman"',
}
"""Feature, as the readers call it, and its description at the beginning of "... is not supported by this version"."""
