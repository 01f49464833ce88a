"""What a file of a stranger is, by its content: only formats that are complete in themselves are known here.

meshio's readers of these open no other file: gmsh, legacy VTK, medit (text) and SU2 are numbers after keywords; VTU is
XML, of which only what declares nothing (no DTD, so no entities) is let through, in an encoding that can be searched.

All of it is read in time linear in its length, by expressions without choices inside repetitions: a thread that matches
one keeps all others waiting.
"""

import mmap
import re

Content = bytes | mmap.mmap
PIECE, LONGEST = 1 << 24, 20  # bytes looked through at a time, and of the words that are looked for
MOST_HEAD = 4096  # bytes in which a format shows
HDF5 = b"\x89HDF\r\n\x1a\n"
ENCODING = re.compile(rb"encoding\s*=\s*[\"']([^\"']*)[\"']")
ENCODINGS = (b"utf-8", b"us-ascii", b"ascii", b"iso-8859-1")
DECLARES = (b"<!doctype", b"<!entity", b"xinclude", b"<?xml-stylesheet")
GMSH = re.compile(rb"\$MeshFormat\s+[24](?:\.\d+)?\s")
SU2 = re.compile(rb"(?:NDIME|NELEM|NPOIN|NMARK)\s*=")
MEDIT = re.compile(rb"MeshVersionFormatted\s+[1-4]\b")
NUMBER = re.compile(rb"[-+]?(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?\d{1,9}+)?$")  # ++: digits are never tried anew
NAMES = {b"x", b"y", b"z", b"r", b"radius"}
PARTICLES = "particles"
MESHES = ("gmsh", "vtk", "vtu", "medit", "su2")  # by meshio's names


class UnknownFileError(ValueError):
    """A file that is not taken; the message says why, in a sentence."""


def kind_of(content: Content) -> str:
    """One of MESHES, or PARTICLES. Raises `UnknownFileError`."""
    if is_hdf5(content):
        raise UnknownFileError("is HDF5, which can refer to other files")
    head = content[:MOST_HEAD]
    if head.startswith((b"$MeshFormat", b"$Comments")):
        if GMSH.search(head) is None:
            raise UnknownFileError("is a mesh of gmsh in a version other than 2 or 4")
        return "gmsh"
    if head.startswith(b"# vtk DataFile Version"):
        return "vtk"
    if head.lstrip()[:1] == b"<":
        return _xml(content)
    if MEDIT.match(_without_comments(head, b"#")):
        return "medit"
    if SU2.match(_without_comments(head, b"%")):
        return "su2"
    if _is_table(head):
        return PARTICLES
    raise UnknownFileError("is none of the known: gmsh 2 or 4, legacy VTK, VTU, medit, SU2, particles as text")


def is_hdf5(content: Content) -> bool:
    """Whether its signature is where the library looks: at 0, 512 and the doubles of that."""
    place = 0
    while place < len(content):
        if content[place : place + len(HDF5)] == HDF5:
            return True
        place = 2 * place or 512
    return False


def _without_comments(head: bytes, mark: bytes) -> bytes:
    """What comes after blank lines and lines that begin with the mark."""
    while (head := head.lstrip()).startswith(mark):
        head = head.partition(b"\n")[2]
    return head


def _xml(content: Content) -> str:
    head, declared = content[:MOST_HEAD].lstrip(), b""
    if head.startswith(b"<?xml"):
        declared, _, head = head.partition(b"?>")
    while (head := head.lstrip()).startswith(b"<!--"):
        head = head.partition(b"-->")[2]
    if not head.startswith(b"<VTKFile"):
        raise UnknownFileError("is XML other than VTU: one that begins with <VTKFile>")
    said = ENCODING.search(declared)
    if said is not None and said[1].lower() not in ENCODINGS:
        raise UnknownFileError("is XML in an encoding other than UTF-8, ASCII or ISO-8859-1")
    for start in range(0, len(content), PIECE):
        low = content[start : start + PIECE + LONGEST].lower()
        if any(word in low for word in DECLARES):
            raise UnknownFileError("is XML that declares or includes something")
    return "vtu"


def _is_table(head: bytes) -> bool:
    """Whether the first line that says something is one of numbers, or of names of columns."""
    for line in head.removeprefix(b"\xef\xbb\xbf").splitlines():
        if not (text := line.strip()) or text.startswith(b"#"):
            continue
        cells = [cell.strip() for cell in re.split(rb"[,;]|\s+", text)]
        return all(NUMBER.match(cell) or cell.lower() in NAMES for cell in cells if cell)
    return False
