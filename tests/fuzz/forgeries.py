"""Folders of studies that somebody forged, who knows how digests are made.

Each generator yields, for a study that is whole, the name of a forgery, a function that forges a copy of it, and
whether reading it must be refused; others may be accepted as the studies that they claim to be.
"""

import contextlib
import functools
import io
import json
import os
import random
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from mjx_study.disk import temporary_name
from mjx_study.storage.arrays import digest_of_arrays
from mjx_study.storage.folder import Store, load_study
from mjx_study.storage.manifest import sealed
from tests.faults import put_no_file
from tests.fuzz.answers import Row, WrongError
from tests.fuzz.studies import STUDIES, draw, make, resume

VALUES: Final = (
    None, True, -1, 0, 10**9, 10**30, 1e308, float("nan"), "", "$x^{", "../../x", "a\nb", [], [1], {}, {"a": 1}
)  # fmt: skip
"""What stands in place of a value of study.json."""


def places_in(document: Any, depth: int = 5) -> Iterator[tuple[Any, ...]]:
    """Paths of all values of a document; of a list, those in its first and last item."""
    if depth and isinstance(document, dict | list) and document:
        keys = list(document) if isinstance(document, dict) else sorted({0, len(document) - 1})
        for key in keys:
            yield (key,)
            yield from ((key, *rest) for rest in places_in(document[key], depth - 1))


def with_value(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A document with another value at a place; without the key if the value is `...`."""
    changed = json.loads(json.dumps(document))
    holder = changed
    for key in place[:-1]:
        holder = holder[key]
    if value is ...:
        del holder[place[-1]]
    else:
        holder[place[-1]] = value
    return changed


def rewritten(folder: Path, document: dict[str, Any], cells: dict[int, dict[str, Any]]) -> None:
    """Write a study of any document and arrays, with digests that match as far as they can be made."""
    (folder / "study.json").write_bytes(sealed(document))
    with contextlib.suppress(Exception):  # a document without what identifies a cell
        store = Store(folder, document)
        for index, arrays in cells.items():
            store.file(index).write(arrays, {"jax": "1"})


Forgery = Callable[[Path, Path], object]
"""Forges a study in a folder, given one outside it that must stay as it is."""


def documents(folder: Path) -> Iterator[tuple[str, Forgery, bool]]:
    """Forgeries of study.json: every value in turn is another, or is missing."""
    store = Store.open(folder)
    cells = {index: store.read(index) for index in range(len(store.document["cells"]))}
    for place in places_in(store.document):
        for value in (*VALUES, ...):
            changed = with_value(store.document, place, value)
            name = f"study.json {'.'.join(map(str, place))} = {value!r}"
            yield name, lambda at, _, changed=changed: rewritten(at, changed, cells), False


def arrays_of(folder: Path) -> Iterator[tuple[str, Forgery, bool]]:
    """Forgeries of a cell's arrays: missing, of other shapes and types, and with odd numbers."""
    store = Store.open(folder)
    document, cell = store.document, store.read(0)
    changes: dict[str, Callable[[np.ndarray], Any]] = {
        "an axis more": lambda array: array[None],
        "no axis": lambda array: np.float64(0),
        "empty": lambda array: array[:0],
        "twice": lambda array: np.concatenate([array, array], axis=-1),
        "texts": lambda array: array.astype("U"),
        "complex": lambda array: array.astype(complex),
        "times": lambda array: np.zeros(array.shape, "M8[s]"),
        "objects": lambda array: array.astype(object),
        "records": lambda array: np.zeros(array.shape, "f8,i4"),
    }
    odd: dict[str, Callable[[np.ndarray], Any]] = {
        "NaN": lambda array: np.full_like(array, np.nan),
        "infinite": lambda array: np.full_like(array, np.inf),
        "zero": np.zeros_like,
        "negative": lambda array: np.full_like(array, -1),
        "huge": lambda array: np.full_like(array, 1e308),
        "tiny": lambda array: np.full_like(array, 5e-324),
        "bool": lambda array: array.astype(bool),
    }
    known = set(load_study(folder).data_vars) & cell.keys()
    for name, array in cell.items():
        if name not in known:
            continue
        for what, change in (changes | odd).items():
            if array.ndim == 0 and what in ("no axis", "empty", "twice"):
                continue
            altered = cell | {name: np.asarray(change(array))}
            yield f"{name} {what}", lambda at, _, new=altered: rewritten(at, document, {0: new}), what in changes
        without = {key: each for key, each in cell.items() if key != name}
        yield f"no {name}", lambda at, _, new=without: rewritten(at, document, {0: new}), False


def packed(arrays: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """An .npz of any members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as members:
        for name, content in arrays.items():
            members.writestr(name, content)
    return file.getvalue()


def npy(shape: Any, descr: str = "<f8", content: bytes = b"", *, version: bytes = b"\x01\x00") -> bytes:
    """A .npy file whose header promises anything."""
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b"\n"
    length = len(header).to_bytes(2 if version == b"\x01\x00" else 4, "little")
    return b"\x93NUMPY" + version + length + header + content


@functools.cache
def archives() -> dict[str, bytes]:
    """Archives that are none of a cell."""
    return {
        "a bomb": packed({"variance.npy": npy((5 * 10**8,), content=bytes(4 * 10**8))}, zipfile.ZIP_DEFLATED),
        "a compressed member": packed({"digest.npy": npy((1,), content=bytes(8))}, zipfile.ZIP_DEFLATED),
        "bzip2": packed({"a.npy": bytes(10**6)}, zipfile.ZIP_BZIP2),
        "lzma": packed({"a.npy": bytes(10**6)}, zipfile.ZIP_LZMA),
        "a promise of terabytes": packed({"digest.npy": npy("(10**12,)"), "variance.npy": npy((10**12,))}),
        "a shape that is no shape": packed({"digest.npy": npy("'abc'")}),
        "a negative shape": packed({"digest.npy": npy("(-1,)")}),
        "a deep header": packed({"digest.npy": npy("(" * 3000)}),
        "a pickle": packed({"digest.npy": npy((1,), "|O", b"cos\nsystem\n")}),
        "another version": packed({"digest.npy": npy((1,), version=b"\x03\x00", content=bytes(8))}),
        "members outside": packed({"../../outside.npy": npy((1,), content=bytes(8)), "/tmp/outside.npy": npy((0,))}),
        "many members": packed({f"{index}.npy": npy((0,)) for index in range(30_000)}),
        "no members": packed({}),
    }


def containers(folder: Path) -> Iterator[tuple[str, Forgery, bool]]:
    """Forgeries of the file of a cell or a checkpoint."""
    whole = (folder / "cells" / "00000.npz").read_bytes()
    directory = whole.rindex(b"PK\x05\x06")
    members = archives() | {
        "nonsense": b"nonsense",
        "nothing": b"",
        "half": whole[: len(whole) // 2],
        "no directory": whole[:directory],
        "twice": whole + whole,
        "a directory alone": whole[directory:],
        "a count of members": whole[:-14] + b"\xff\xff\xff\xff" + whole[-10:],
        "a place of the directory": whole[:-6] + b"\xff" * 4 + whole[-2:],
        "a comment": whole[:-2] + b"\x04\x00abcd",
        "zeros": bytes(10_000),
        "a pickle alone": b"cos\nsystem\n(S'true'\ntR.",
    }
    for name, content in members.items():
        for place in ("00000.npz", "00001.part.npz"):
            harmless = name in ("a comment", "twice", "a count of members")

            def forge(at: Path, _: Path, content: bytes = content, place: str = place) -> None:
                if "part" in place:
                    (at / "cells" / "00001.npz").unlink()
                (at / "cells" / place).write_bytes(content)

            yield f"{place}: {name}", forge, not harmless and "part" not in place
    store = Store.open(folder)
    arrays, _ = store.read_with_versions(0)
    for name, versions in {"a list": "[]", "a number": '{"jax": 1}', "no JSON": "{", "none": None}.items():

        def written(at: Path, _: Path, versions: str | None = versions) -> None:
            kept = dict(arrays) | ({} if versions is None else {"versions": np.array(versions)})
            file = Store(at, store.document).file(0)
            signed = np.array([digest_of_arrays(kept), file.study, file.cell])
            np.savez(file.path, digest=signed, **kept)  # type: ignore[arg-type]

        yield f"versions of a cell: {name}", written, True


def _sparse(path: Path, _: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(10**12)


def _unreadable(path: Path, _: Path) -> None:
    path.write_bytes(b"x")
    os.chmod(path, 0)


ENTRIES: Final[dict[str, Forgery]] = {
    **{kind: lambda path, _, kind=kind: put_no_file(path, kind) for kind in ("fifo", "socket", "device", "folder")},
    "a link to a file": lambda path, outside: path.symlink_to(outside / "file"),
    "a link to nothing": lambda path, outside: path.symlink_to(outside / "new"),
    "a link to itself": lambda path, _: path.symlink_to(path),
    "a link to a folder": lambda path, outside: path.symlink_to(outside),
    "a terabyte of nothing": _sparse,
    "unreadable": _unreadable,
}
"""What stands in place of a file."""


def entries(folder: Path) -> Iterator[tuple[str, Forgery, bool]]:
    """Forgeries of what lies in a folder: links, pipes, sockets, devices, folders and sparse files."""
    for place in ("study.json", "study.lock", "results.nc", "cells/00000.npz", "cells/00001.part.npz"):
        for name, put in ENTRIES.items():

            def replaced_file(at: Path, outside: Path, place: str = place, put: Forgery = put) -> None:
                if "00001" in place:
                    (at / "cells" / "00001.npz").unlink()
                (at / place).unlink(missing_ok=True)
                put(at / place, outside)

            yield f"{place}: {name}", replaced_file, place in ("study.json", "cells/00000.npz")

    def moved(at: Path, outside: Path) -> None:
        shutil.copytree(at / "cells", outside / "cells", dirs_exist_ok=True)
        shutil.rmtree(at / "cells")

    yield "cells: moved", moved, False
    for name in ("a link to a folder", "fifo", "socket", "device"):

        def cells_replaced(at: Path, outside: Path, put: Forgery = ENTRIES[name]) -> None:
            shutil.rmtree(at / "cells")
            put(at / "cells", outside)

        yield f"cells: {name}", cells_replaced, "link" in name

    def leftovers(at: Path, outside: Path) -> None:
        for target in (outside / "file", outside / "new"):
            (at / temporary_name("study.json")).symlink_to(target)
            (at / "cells" / temporary_name("00000.npz")).symlink_to(target)
        os.mkfifo(at / temporary_name("a"))

    yield "leftovers: links and pipes", leftovers, False
    contents = (
        b"", b"{", b"[]", b"null", b"1e999", b"[" * 10**5, b'{"a":' * 10**4, b"\xff\xfe{}", b'{"format": 4}',
        b'{"format": 1e9}', b'{"format": true}', b'{"format": 3}', b'{"format": "4"}',
        b'{"format": 4' + b" " * 10**6 + b"}", b'{"format": 1' + b"0" * 5000 + b"}",
    )  # fmt: skip
    for content in contents:
        write = lambda at, _, content=content: (at / "study.json").write_bytes(content)  # noqa: E731
        yield f"study.json: {content[:16]!r}", write, True


FORGERIES: Final = {
    "forged folders: study.json": documents,
    "forged folders: arrays": arrays_of,
    "forged folders: files of cells": containers,
    "forged folders: links, pipes, devices": entries,
}


def forge(kind: str, count: int, root: Path) -> Row:
    """Forge folders of each kind of study, and draw and resume them."""
    row, root, outside = Row(kind), root / "studies", root / "outside"
    made = {each: make(each, root) for each in STUDIES}
    every = [(study, *each) for study, folder in made.items() for each in FORGERIES[kind](folder)]
    for study, name, change, refuse in random.Random(0).sample(every, min(count, len(every))):
        at = root / "forged"
        for folder in (at, outside):
            shutil.rmtree(folder, ignore_errors=True)
        outside.mkdir()
        (outside / "file").write_text("somebody's")
        shutil.copytree(made[study], at)
        change(at, outside)
        with row.counting(f"{study}, {name}"):
            codes = [draw(at, outside)]
            if codes == [0]:
                codes.append(draw(at, outside, "report"))
            row.codes[codes[-1]] += 1
            codes.append(resume(study, at, outside))
            if refuse and 0 in codes:
                raise WrongError(f"accepted: exit codes {codes}")
    return row
