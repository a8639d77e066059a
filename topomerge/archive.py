"""Files that are written whole, archives of arrays read with limits, and weights that ship."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import platform
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from topomerge.errors import InputError, is_memory_short
from topomerge.types import Array

PART_SUFFIX = ".part"  # of the folders in which files are written
PART_NAME = re.compile(r"\.([0-9a-f]{8})-(\d+)\.[^.]*\.part$")  # machine and process of the one that writes


LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"


def refuse_pointer(path: Path) -> None:
    """Refuse a file that Git LFS put in place of the one that is wanted.

    Raises:
        InputError: it is a pointer of Git LFS.
    """
    with path.open("rb") as stream:
        if stream.read(len(LFS_POINTER)) == LFS_POINTER:
            raise InputError(f"{path}: is a Git LFS pointer, not the file; run `git lfs pull`")


def convert_to_plain(value: Any) -> Any:
    """Return the value in Python's own types, as far as JSON has them: arrays and tuples as lists, anything odd as its text."""
    if isinstance(value, np.ndarray | np.generic):
        return convert_to_plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): convert_to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [convert_to_plain(item) for item in (sorted(value) if isinstance(value, set | frozenset) else value)]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


@contextmanager
def replace_on_success(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same name; rename it to `path` on success, delete it on any error.

    A link is followed: what it points to is replaced. The permissions of what is replaced stay.

    Raises:
        InputError: the folder does not exist or can't be written, or `path` is no regular file, or write-protected.
    """
    path = Path(path)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no file that could be replaced; give the name of a file")
    mode = path.stat().st_mode & 0o777 if path.exists() else None
    if mode is not None and not mode & 0o222:
        raise InputError(f"{path}: is write-protected; make it writable, or give another name")
    try:
        _delete_stale_parts(path.parent)
        # A folder of its own, so that what a kill leaves behind is nowhere found under the file's suffix.
        prefix = f".{path.stem[:40]}.{_compute_machine_id()}-{os.getpid()}."
        folder = Path(tempfile.mkdtemp(prefix=prefix, suffix=PART_SUFFIX, dir=path.parent))
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: can't be written ({reason}); give a folder that exists and is yours") from error
    temporary = folder / path.name
    try:
        temporary.touch()
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask if mode is None else mode)
        try:
            temporary.replace(path)
        except OSError as error:
            raise InputError(f"{path}: can't be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _compute_machine_id() -> str:
    """Return a short name of the machine, or the container, whose numbers of processes those of this process are."""
    space = Path("/proc/self/ns/pid")
    numbers = os.readlink(space) if os.path.lexists(space) else ""
    return hashlib.sha256(f"{platform.node()} {numbers}".encode()).hexdigest()[:8]


@cache
def _delete_stale_parts(folder: Path) -> None:
    """Delete, once a process, what killed processes of this machine left in a folder."""
    if os.name != "posix":  # elsewhere a signal can't ask for a process
        return
    for left in folder.glob(f".*{PART_SUFFIX}"):
        owner = PART_NAME.search(left.name)
        if owner is not None and owner[1] == _compute_machine_id() and not _is_running(int(owner[2])):
            shutil.rmtree(left, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


DATE = (1980, 1, 1, 0, 0, 0)  # the first that a zip can tell
ARCHIVE_LIMIT = 4 << 30  # of all arrays together; a map of 100 million cells needs 2 GB
MAX_RATIO = 1100  # deflate can't shrink by more than 1032; a file that claims more is damaged or hostile
USUAL_RATIO, MODEST = 100, 1 << 28  # of a whole file: maps shrink by 12 to 17; small ones may claim more
PART = 1 << 20  # bytes that are unpacked at a time
LONGEST_ARRAY_HEADER = 4096  # longest header of an array, bytes
R = TypeVar("R")


def write(arrays: Mapping[str, Array], path: str | Path, effort: int = 6) -> None:
    """Write named arrays. The same arrays in the same order give the same bytes.

    Args:
        effort: of compression, 0 (none: read five times as fast) to 9.

    Raises:
        InputError: the path can't be written.
    """
    with replace_on_success(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # else it tells the platform
            entry.external_attr = 0o644 << 16
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
            archive.writestr(entry, buffer.getbuffer(), compresslevel=effort)


def read(path: str | Path, kind: str = "archive", only: Collection[str] | None = None) -> dict[str, Array]:
    """Read arrays of a file that may be damaged or hostile.

    Args:
        path: the file.
        kind: what it should be, for messages.
        only: names of the arrays to read, of which those that are not there are left out; None: all.

    Raises:
        InputError: no such file, not such an archive, damaged, or it declares more than it can hold.
    """
    return _apply_to_archive(
        path, kind, lambda archive, size: {name: _read_array(archive, e) for name, e in _list_entries(archive, size, only)}
    )


def list_arrays(path: str | Path, kind: str = "archive") -> list[str]:
    """List names of the arrays of such a file, without reading them.

    Raises:
        InputError: as `read`; damage of the arrays is not looked for.
    """
    return _apply_to_archive(path, kind, lambda archive, size: [name for name, _ in _list_entries(archive, size)])


class ArrayHeader(NamedTuple):
    """Shape and type that an array of an archive declares."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Numbers or rows in it."""
        return math.prod(self.shape)


def read_array_headers(path: str | Path, kind: str = "archive") -> dict[str, ArrayHeader]:
    """Read the headers of the arrays of such a file, checked as by `read`, without unpacking more than them.

    Raises:
        InputError: as `read`.
    """
    return _apply_to_archive(
        path, kind, lambda archive, size: {name: _read_header(archive, e) for name, e in _list_entries(archive, size)}
    )


def _apply_to_archive(path: str | Path, kind: str, use: Callable[[zipfile.ZipFile, int], R]) -> R:
    """Apply `use` to an archive and the size of its file; every error names the file."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a {kind}; name a file")
    if path.exists() and not path.is_file():  # to open a pipe would wait for ever
        raise InputError(f"{path}: is no regular file (a pipe or a device), not a {kind}; name a file")
    try:
        refuse_pointer(path)
        with path.open("rb") as file:
            start = file.read(4)
            if not start:
                raise InputError(f"{path}: is empty; make the {kind} again")
            if start[:2] != b"PK":
                raise InputError(f"{path}: is not a {kind}; check the name, or make one again")
            with zipfile.ZipFile(file) as archive:
                return use(archive, path.stat().st_size)
    except (InputError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except PermissionError as error:
        raise InputError(f"{path}: can't be read (permission denied); check its permissions") from error
    except Exception as error:  # damage can surface anywhere in zipfile, zlib and NumPy, as nearly any exception
        if is_memory_short(error):
            raise MemoryError(str(error)) from error
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: damaged or cut off ({reason}); copy or make the {kind} again") from error


def _list_entries(archive: zipfile.ZipFile, size: int, only: Collection[str] | None = None) -> list[tuple[str, zipfile.ZipInfo]]:
    """List the names and places of the arrays in a file of so many bytes; what they declare is checked before any is read."""
    entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
    if entries and len({entry.filename for entry in entries}) < len(archive.infolist()):
        raise ValueError("something is in it twice, or is no array")
    for entry in entries:
        if entry.compress_size > size or entry.file_size > MAX_RATIO * (entry.compress_size + 16):
            raise ValueError(f"{entry.filename} claims {entry.file_size} bytes, more than it can hold")
    total = sum(entry.file_size for entry in entries)
    if total > ARCHIVE_LIMIT or total > max(MODEST, USUAL_RATIO * size):
        raise ValueError(f"claims {total:,} bytes in {size:,}")
    named = [(entry.filename.removesuffix(".npy"), entry) for entry in entries]
    return [(name, entry) for name, entry in named if only is None or name in only]


def _read_header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> ArrayHeader:
    with archive.open(entry) as stream:
        return _parse_header(entry, stream)[0]


def _parse_header(entry: zipfile.ZipInfo, stream: IO[bytes]) -> tuple[ArrayHeader, bytes]:
    """Return the declared shape and type of one array, which must fill the entry to the byte; and what was read behind its
    header."""
    head = io.BytesIO(stream.read(LONGEST_ARRAY_HEADER))
    version = np.lib.format.read_magic(head)
    if version != (1, 0):
        raise ValueError(f"{entry.filename} has an array format {version} that maps don't use")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(head, max_header_size=LONGEST_ARRAY_HEADER)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} holds pickled objects, which are not read for safety")
    if by_columns or any(s < 0 for s in shape):
        raise ValueError(f"{entry.filename} has a layout that maps don't use")
    if head.tell() + math.prod(shape) * dtype.itemsize != entry.file_size:
        raise ValueError(f"{entry.filename} claims shape {shape}, which is not its size")
    return ArrayHeader(shape, dtype), head.read()


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Array:
    """Unpack one array into the memory that it stays in."""
    with archive.open(entry) as stream:
        head, start = _parse_header(entry, stream)
        body = bytearray(head.size * head.dtype.itemsize)
        view = memoryview(body)
        view[: len(start)] = start
        at = len(start)
        while at < len(body):
            part = stream.read(min(PART, len(body) - at))
            if not part:
                raise EOFError(f"{entry.filename} is cut short")
            view[at : at + len(part)] = part
            at += len(part)
        stream.read(1)  # reading to the end also checks the CRC
    return np.frombuffer(body, head.dtype, count=head.size).reshape(head.shape)


VARIABLE = "TOPOMERGE_WEIGHTS"


def find_weights_file(package: str, name: str) -> Path:
    """Find the file `name` of the folder that `VARIABLE` names, if it is there; else that of `package`."""
    folder = os.environ.get(VARIABLE)
    if folder:
        if not Path(folder).is_dir():
            raise InputError(f"{VARIABLE}: {folder} is no folder; name one with exported weights, or unset it")
        if (Path(folder) / name).is_file():
            return Path(folder) / name
    return _find_packaged_file(package, name)


@cache
def _find_packaged_file(package: str, name: str) -> Path:
    return Path(str(resources.files(package).joinpath(name)))


def read_weights_json(package: str, name: str) -> dict[str, Any]:
    """Read a JSON file of weights, once.

    Raises:
        InputError: it is damaged, or no table.
    """
    return _read(find_weights_file(package, name))


@lru_cache(maxsize=16)
def _read(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({' '.join(str(error).split())[:120]}); install topomerge again") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds no table of weights; install topomerge again")
    return values
