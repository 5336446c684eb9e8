"""Write froude_messages.py from froude.xml: `python -m bridge.dialect.generate`."""

from __future__ import annotations

import sys
from pathlib import Path

from pymavlink.generator import mavgen

HERE = Path(__file__).parent
SOURCE = HERE / "froude.xml"
MODULE = HERE / "froude_messages.py"


def generate(module: Path) -> None:
    """Write the Python module of froude.xml.

    Args:
        module: the file to write, ending in .py.
    """
    options = mavgen.Opts(str(module.with_suffix("")), wire_protocol="2.0", language="Python", validate=False)
    if not mavgen.mavgen(options, [str(SOURCE)]):
        raise SystemExit(f"{SOURCE}: mavgen refused it; its reason is printed above")


if __name__ == "__main__":
    generate(MODULE)
    sys.stdout.write(f"{MODULE} written\n")
