"""Text files from the user's hands: read whole, if they are files of a reasonable size and hold text.

try:
    text = read_text(path)
except UnreadableError as error:
    print(f"{path}: {error}")
"""

from __future__ import annotations

import stat
from pathlib import Path

BYTES_MAX = 1 << 20
"""Far beyond the largest puppet or the longest score that anybody writes."""


class UnreadableError(Exception):
    """A file cannot be read as text; the message says why, and what was expected."""


def read_text(path: str | Path, encoding: str = "utf-8", bytes_max: int = BYTES_MAX) -> str:
    """Return a file's text. Raises UnreadableError: for what is no regular file, is larger than `bytes_max`, or holds no text."""
    try:
        # What is no file may have no end, or keep whoever opens it waiting for a writer.
        mode = Path(path).stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise UnreadableError("cannot be read: is a device, a pipe or a socket, expected a file")
        with Path(path).open("rb") as file:
            data = file.read(bytes_max + 1)
    except OSError as error:
        raise UnreadableError(f"cannot be read: {(error.strerror or str(error)).lower()}") from None
    except ValueError:  # a null character in the name
        raise UnreadableError("cannot be read: no such file") from None
    if len(data) > bytes_max:
        raise UnreadableError(f"is larger than {bytes_max} bytes, expected a smaller file")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise UnreadableError(f"found the byte {data[error.start]:#04x}, expected a text file in UTF-8") from None
