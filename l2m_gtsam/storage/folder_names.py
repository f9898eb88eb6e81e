"""Names of folders that are made of names which others chose."""

import hashlib
import unicodedata
from collections import Counter
from collections.abc import Sequence

LONGEST = 60  # letters: four bytes each and a digest are still a name for every file system
DIGITS = 8  # of the digest that tells names apart
PLAIN = "._-+ "  # beside letters and digits


def folder_names(
    names: Sequence[str], identities: Sequence[str], reserved: Sequence[str] = ()
) -> list[str]:
    """Return a folder's name for each of these names, no two alike on any file system.

    A name that is one already stays as it is. Any other, and all of those that are alike but for
    upper and lower case, get a few digits of a digest. So the name of one does not depend on the
    order in which they stand, and on others only when they are like it: one that had no digits gets
    them when another like it is added.

    Parameters
    ----------
    names
        Any text.
    identities
        What stands behind each, unique.
    reserved
        Names that are taken.
    """
    safe = [_safe(name) for name in names]
    taken = Counter(map(_alike, safe)) + Counter({_alike(name): 1 for name in reserved})
    return [
        made if made == name and taken[_alike(made)] == 1 else f"{made}-{_digits(identity)}"
        for name, made, identity in zip(names, safe, identities, strict=True)
    ]


def printable(text: str) -> str:
    """Return text that can be written and shown anywhere: without control characters."""
    told = text.encode("utf-8", "replace").decode("utf-8")
    return "".join("\N{REPLACEMENT CHARACTER}" if _controls(each) else each for each in told)


def _safe(name: str) -> str:
    letters = (each if each.isalnum() or each in PLAIN else "_" for each in name)
    return "".join(letters)[:LONGEST].lstrip(". -").rstrip(". ") or "_"


def _alike(name: str) -> str:
    return unicodedata.normalize("NFKC", name).casefold()


def _digits(identity: str) -> str:
    return hashlib.sha256(identity.encode(errors="surrogatepass")).hexdigest()[:DIGITS]


def _controls(letter: str) -> bool:
    """Return whether a letter is a control character, or changes the direction of others."""
    return unicodedata.category(letter) in ("Cc", "Cf", "Zl", "Zp")
