"""Key files: a signing key on disk, for its owner's eyes only.

PX4's form is 40 bytes: the secret (32) and the timestamp (8, little-endian). The same written as 80 hexadecimal
digits is read too, and either without the timestamp, which is then 0. A file keeps its form. MAVProxy and
QGroundControl make their secret of a passphrase by SHA-256, so this makes theirs:

    (umask 077; printf %s 'the passphrase' | sha256sum | cut -c1-64 > signing.key)
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from bridge.signing import LATEST, NO_KEY, SECRET_BYTES, SigningKey
from sitl.errors import FileError

_TIMESTAMP_BYTES = 8
_FORMS = (SECRET_BYTES, SECRET_BYTES + _TIMESTAMP_BYTES)
_MOST_BYTES = 256
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def load_key(path: str | Path, *, may_be_missing: bool = False) -> SigningKey:
    """Read a key file.

    Args:
        path: the file itself, not a link to it.
        may_be_missing: a file that does not exist, or an empty one, is that of a vehicle that has no key yet.

    Returns:
        the key; it is not `initialised` where the file holds zeros only, as PX4 leaves it when a key is cleared.

    Raises:
        FileError: it cannot be read, is no regular file, is open to group or others, or holds no key.
    """
    path = Path(path)
    try:
        data = _read(path)
    except FileNotFoundError:
        if may_be_missing:
            return NO_KEY
        raise FileError(
            path, "there is no such signing key file", "Make one: (umask 077; head -c 32 /dev/urandom > FILE)"
        ) from None
    return NO_KEY if may_be_missing and not data else _parse(path, data)


def save_key(path: str | Path, key: SigningKey) -> None:
    """Write a key file whole or not at all, readable by its owner only.

    Raises:
        FileError: it cannot be written, or what is there is no regular file; then that is unchanged.
    """
    path = Path(path)
    data = key.secret + key.timestamp.to_bytes(_TIMESTAMP_BYTES, "little")
    try:
        if _is_text(path):
            data = data.hex().encode() + b"\n"
        _replace(path, data)
    except OSError as error:
        raise FileError(
            path,
            f"the signing key cannot be written ({error.strerror or error})",
            "Check the folder, its permissions and the space left on the disk",
        ) from None


def save_timestamp(path: str | Path, key: SigningKey) -> bool:
    """Bring the timestamp of a key file up to date, so that nothing signed so far is believed after a restart.

    A file that holds another secret by now, or a later timestamp, belongs to somebody else and is left alone.

    Returns:
        whether the file was written.

    Raises:
        FileError: as `load_key` and `save_key`.
    """
    stored = load_key(path, may_be_missing=True)
    if not stored.same_secret(key) or stored.timestamp >= key.timestamp:
        return False
    save_key(path, key)
    return True


def _read(path: Path) -> bytes:
    """Return what a key file holds, too long contents cut; FileNotFoundError is the caller's."""
    try:
        # Without blocking, so that a pipe is refused instead of waited for.
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise FileError(path, "a signing key cannot be a symbolic link", "Name the file itself") from None
        raise FileError(path, f"the signing key cannot be read ({error.strerror})", "Check its owner") from None
    try:
        # Of the file that is open, so that nobody can exchange it between the look and the reading.
        mode = os.fstat(handle).st_mode
        if not stat.S_ISREG(mode):
            raise FileError(path, "a signing key has to be a regular file", "Name a file")
        if mode & _OTHERS:
            raise FileError(
                path,
                f"the signing key is open to others than its owner (mode {stat.S_IMODE(mode):04o})",
                f"Run: chmod 600 {path}",
            )
        return os.read(handle, _MOST_BYTES)
    except OSError as error:
        raise FileError(path, f"the signing key cannot be read ({error.strerror})", "Check the disk") from None
    finally:
        os.close(handle)


def _parse(path: Path, data: bytes) -> SigningKey:
    raw = data
    if len(data) > max(_FORMS):
        try:
            raw = bytes.fromhex(data.decode("ascii"))
        except ValueError:
            raw = b""
    if len(raw) not in _FORMS:
        size = f"{len(data)} bytes" if len(data) < _MOST_BYTES else f"{_MOST_BYTES} bytes or more"
        raise FileError(
            path,
            f"{size} are no signing key",
            "It has 32 bytes or 64 hexadecimal digits, with its timestamp 40 bytes or 80 digits",
        )
    timestamp = int.from_bytes(raw[SECRET_BYTES:], "little")
    if timestamp > LATEST:
        raise FileError(
            path,
            f"the signing key's timestamp {timestamp} does not fit 48 bits",
            "Its last 8 bytes are 10 us since 2015, little-endian; write zeros if in doubt",
        )
    return SigningKey(raw[:SECRET_BYTES], timestamp)


def _is_text(path: Path) -> bool:
    """Whether the file that is to be replaced is written in hexadecimal digits; refuses what is no file."""
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return False
    if not stat.S_ISREG(found.st_mode):
        raise FileError(path, "a signing key is written to a regular file only", "Name a file, not a link to it")
    return found.st_size > max(_FORMS)


def _replace(path: Path, data: bytes) -> None:
    """Put a file of these bytes in place of the one there, after they are on the disk."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(name).unlink()
        raise
