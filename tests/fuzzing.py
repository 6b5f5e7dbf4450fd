"""Damages to valid files, and what a reader may do with them: give valid data, or raise one short error."""

import copy
import os
import resource
import time
from contextlib import contextmanager
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from torchrl_h2o.data import DataError

LONGEST = 300  # characters of a message, without the name of the file
MOST_SECONDS, MOST_BYTES = 5.0, 2 * 2**30
EXAMPLES = os.environ.get("TORCHRL_H2O_FUZZ")  # a number: that many examples, others in every run
_CHECKS = {"suppress_health_check": list(HealthCheck), "deadline": None}
few = settings(max_examples=10, derandomize=True, **_CHECKS)
some = settings(max_examples=int(EXAMPLES or 100), derandomize=EXAMPLES is None, **_CHECKS)
many = settings(max_examples=int(EXAMPLES or 200), derandomize=EXAMPLES is None, **_CHECKS)

_NUMBERS = [
    b"\xff" * 4,
    b"\xff" * 8,
    b"\0" * 8,
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\0\0\0\0\0\0\0\x40",
    b"\x80",
    b"\0",
]
_WORDS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "1e20",
    "-1",
    "0",
    "",
    '"',
    "'",
    ",",
    ";",
    "\n",
    "\r",
    "#",
    "0x10",
    "1_0",
    "\0",
]
_WORDS += ["é", "١", "[1, 2]", '"[1]"', "(", "true"]
_WORDS += ["null", "[]", "{}", "- ", ": ", "&a [*a]", "${a}", "!!python/object/apply:os.getpid []", "9" * 5000]
_WORDS += ["1e308", "\ud7ff", "2026-13-45", "<<: *a", "? ", "|", "[" * 3000, "x" * 1000, "%", "@", "\t", "---", "..."]
_KINDS = ("replace", "insert", "delete", "cut", "repeat")
_PIECES = st.one_of(st.binary(min_size=1, max_size=8), st.sampled_from(_NUMBERS))
_TEXTS = st.one_of(st.sampled_from([word.encode() for word in _WORDS]), st.text(max_size=8).map(str.encode))


def damages(pieces=_PIECES):
    """A strategy for a few changes of bytes."""
    place = st.floats(0, 1, exclude_max=True)
    return st.lists(st.tuples(st.sampled_from(_KINDS), place, st.integers(1, 64), pieces), min_size=1, max_size=5)


def damaged(content, changes):
    """The bytes of a file after such changes."""
    for kind, share, count, piece in changes:
        at = int(share * len(content))
        end = {"insert": at, "delete": at + count, "cut": len(content), "repeat": at}.get(kind, at + len(piece))
        new = {"delete": b"", "cut": b"", "repeat": content[at : at + count] * count}.get(kind, piece)
        content = content[:at] + new + content[end:]
    return content


text_damages = damages(_TEXTS)
values = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.sampled_from([2**63, 10**400]),
        st.sampled_from(["x" * 2000, "torch.float32", "torch.Tensor", "../../x", "os.system", "inf", "${env.name}"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=4,
)  # fmt: skip
changes_of_entries = st.lists(
    st.tuples(st.sampled_from(["replace", "replace", "delete", "rename", "nest"]), st.integers(0, 10**6), values),
    min_size=1,
    max_size=3,
)


def with_changed_entries(entries, changes):
    """Nested mappings and lists after changes of some of their entries."""
    entries = copy.deepcopy(entries)
    for kind, number, value in changes:
        places = list(_places(entries))
        if not places:
            break
        parent, key = places[number % len(places)]
        if kind == "delete":
            del parent[key]
        elif kind == "rename" and isinstance(parent, dict):
            parent[str(value)] = parent.pop(key)
        else:
            parent[key] = [parent[key]] if kind == "nest" else value
    return entries


def _places(entries):
    keys = entries if isinstance(entries, dict) else range(len(entries)) if isinstance(entries, list) else ()
    for key in list(keys):
        yield entries, key
        yield from _places(entries[key])


def outcome(read, source):
    """What a reader returns, or None for a DataError; asserts its length and the reader's time and memory."""
    before, start, refusal, found = _peak(), time.process_time(), None, None
    try:
        with _limited_memory():
            found = read(source)
    except DataError as error:
        refusal = error
    if refusal is not None:
        assert "\n" not in str(refusal)
        assert len(str(refusal)) <= LONGEST + len(refusal.source or ""), str(refusal)
    assert time.process_time() - start < MOST_SECONDS
    assert _peak() - before < MOST_BYTES
    return found


@contextmanager
def _limited_memory():
    """Lets an allocation beyond the limit fail, instead of filling the machine's memory."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def _peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
