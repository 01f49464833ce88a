"""Characters that are never shown raw: what a terminal would obey, or a reader be misled by."""

import re

HIDDEN = r"\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069"
"""controls, line separators and turned directions, inside the brackets of a regular expression"""
UNSHOWABLE = re.compile(rf"[{HIDDEN}\ud800-\udfff]")
"""these, and halves of surrogate pairs"""


def visible(text: str, keep: str = "") -> str:
    r"""The text with such characters written out, as `\x1b`; those in `keep` stay."""
    return UNSHOWABLE.sub(lambda found: found[0] if found[0] in keep else ascii(found[0])[1:-1], text)
