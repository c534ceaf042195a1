"""What is frozen into the image for the RP2040.

`host/marotte/images.py` lays out a folder `frozen` beside this file: the packages `firmware` and `shared`, without what
only the PC needs, and `main.py`, which MicroPython runs at power-on. Nothing is taken from micropython-lib.
"""

freeze("$(PORT_DIR)/modules")  # noqa: F821  the file system's mount at boot, and the module `rp2`
package("firmware", base_path="frozen")  # noqa: F821
package("shared", base_path="frozen")  # noqa: F821
module("main.py", base_path="frozen")  # noqa: F821
