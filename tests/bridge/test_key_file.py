"""Key files: read in PX4's form or in digits, only when nobody else can read them; written whole or not at all."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bridge.key_file import load_key, save_key, save_timestamp
from bridge.signing import NO_KEY, SigningKey
from sitl.errors import FileError

SECRET = bytes(range(100, 132))
KEY = SigningKey(SECRET, 0x0102030405)
STAMP = bytes([5, 4, 3, 2, 1, 0, 0, 0])


def private(path: Path, data: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    return path


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize(
    ("data", "key"),
    [
        (SECRET + STAMP, KEY),
        (SECRET, SigningKey(SECRET)),
        ((SECRET + STAMP).hex().encode(), KEY),
        (SECRET.hex().upper().encode() + b"\n", SigningKey(SECRET)),
        (bytes(40), NO_KEY),
    ],
    ids=["px4", "secret only", "digits", "digits of the secret", "cleared"],
)
def test_forms(tmp_path: Path, data: bytes, key: SigningKey) -> None:
    assert load_key(private(tmp_path / "key", data)) == key
    assert load_key(str(tmp_path / "key")).initialised == (key != NO_KEY)


@pytest.mark.parametrize("size", [0, 1, 31, 33, 39, 41, 63, 65, 79, 500, 100_000])
def test_another_length_is_named(tmp_path: Path, size: int) -> None:
    path = private(tmp_path / "key", b"a" * size)
    with pytest.raises(FileError, match=r"are no signing key.*64 hexadecimal digits") as caught:
        load_key(path)
    assert f"{path}: {min(size, 256)} bytes" in str(caught.value)


@pytest.mark.parametrize("data", [b"g" * 64, b"\xff" * 64, b"ab" * 31 + b"\n"])
def test_digits_have_to_be_digits(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(FileError, match=f"{len(data)} bytes are no signing key"):
        load_key(private(tmp_path / "key", data))


def test_a_timestamp_beyond_48_bits_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"timestamp 281474976710656 does not fit 48 bits"):
        load_key(private(tmp_path / "key", SECRET + (2**48).to_bytes(8, "little")))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o660, 0o620, 0o610, 0o601, 0o777])
def test_a_file_open_to_others_is_refused(tmp_path: Path, mode: int) -> None:
    path = private(tmp_path / "key", SECRET, mode)
    with pytest.raises(FileError) as caught:
        load_key(path)
    text = str(caught.value)
    assert str(path) in text
    assert f"mode {mode:04o}" in text
    assert f"chmod 600 {path}" in text


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_a_file_for_its_owner_only_is_read(tmp_path: Path, mode: int) -> None:
    assert load_key(private(tmp_path / "key", SECRET, mode)).secret == SECRET


def test_a_link_is_refused_and_never_written_through(tmp_path: Path) -> None:
    target = private(tmp_path / "target", SECRET)
    link = tmp_path / "key"
    link.symlink_to(target)
    with pytest.raises(FileError, match="symbolic link"):
        load_key(link)
    with pytest.raises(FileError, match="not a link"):
        save_key(link, KEY)
    assert target.read_bytes() == SECRET


@pytest.mark.timeout(10)
def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path, tmp_path / "pipe", Path(os.devnull)):
        with pytest.raises(FileError, match="regular file"):
            load_key(path)
        with pytest.raises(FileError, match="regular file"):
            save_key(path, KEY)


def test_a_missing_file_is_an_error_or_a_vehicle_without_a_key(tmp_path: Path) -> None:
    path = tmp_path / "key"
    with pytest.raises(FileError, match=r"no such signing key file.*umask"):
        load_key(path)
    assert load_key(path, may_be_missing=True) == NO_KEY
    assert load_key(private(path, b""), may_be_missing=True) == NO_KEY
    assert load_key(private(path, SECRET), may_be_missing=True).secret == SECRET


def test_a_saved_key_is_px4s_file_for_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "key"
    before = os.umask(0)
    try:
        save_key(path, KEY)
    finally:
        os.umask(before)
    assert path.read_bytes() == SECRET + STAMP
    assert mode_of(path) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_of_digits_stays_one(tmp_path: Path) -> None:
    path = private(tmp_path / "key", SECRET.hex().encode() + b"\n")
    save_key(path, KEY)
    assert path.read_text() == (SECRET + STAMP).hex() + "\n"
    assert load_key(path) == KEY


def test_a_file_that_was_open_to_others_is_closed_by_writing_it(tmp_path: Path) -> None:
    path = private(tmp_path / "key", bytes(40), 0o644)
    save_key(path, KEY)
    assert mode_of(path) == 0o600


def test_a_key_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = private(tmp_path / "key", SECRET + STAMP)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FileError, match=r"No space left on device.*space left on the disk"):
        save_key(path, SigningKey(bytes(32), 7))
    assert load_key(path) == KEY
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileError, match="cannot be written"):
        save_key(tmp_path / "nowhere" / "key", KEY)


def test_the_timestamp_only_goes_on_and_only_of_the_same_key(tmp_path: Path) -> None:
    path = tmp_path / "key"
    assert not save_timestamp(path, KEY)  # nobody makes a file of a key that was taken away
    assert not path.exists()
    save_key(path, KEY)
    assert save_timestamp(path, SigningKey(SECRET, KEY.timestamp + 1))
    assert not save_timestamp(path, KEY)
    assert not save_timestamp(path, SigningKey(bytes(32), KEY.timestamp + 9))
    assert load_key(path) == SigningKey(SECRET, KEY.timestamp + 1)
    path.chmod(0o644)
    with pytest.raises(FileError, match="chmod 600"):
        save_timestamp(path, SigningKey(SECRET, KEY.timestamp + 5))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(secret=st.binary(min_size=32, max_size=32), timestamp=st.integers(0, 2**48 - 1), digits=st.booleans())
def test_what_is_saved_is_read(tmp_path: Path, secret: bytes, timestamp: int, digits: bool) -> None:
    path = private(tmp_path / "key", b"0" * 64 if digits else b"")
    save_key(path, SigningKey(secret, timestamp))
    assert load_key(path) == SigningKey(secret, timestamp)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.one_of(st.binary(max_size=300), st.text("0123456789abcdef \n", max_size=90).map(str.encode)))
def test_any_file_is_a_key_or_an_error(tmp_path: Path, data: bytes) -> None:
    path = private(tmp_path / "key", data)
    if len(data) in (32, 40) or (len(data) > 40 and len(data.split()) == 1 and len(data.strip()) in (64, 80)):
        with suppress(FileError):
            assert len(load_key(path).secret) == 32
    else:
        with suppress(FileError):
            assert load_key(path).secret == bytes.fromhex(data.decode())[:32]
