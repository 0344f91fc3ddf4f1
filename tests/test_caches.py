"""Caches on disk: private, checked before use, and remade if damaged."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from mjx_study import disk, runtime
from mjx_study.caches import digested, read_cached, undigested, write_cached
from mjx_study.disk import private_folder
from mjx_study.runtime import configure, traces_folder
from tests.faults import NO_FILES, deadline, put_no_file


def test_a_digest_is_checked() -> None:
    for content in (b"", b"\n", b"content"):
        assert undigested(digested(content)) == content
        for damaged in (digested(content)[:-1], digested(content) + b"x", b"x" + content, b""):
            with pytest.raises(ValueError, match="its digest does not match"):
                undigested(damaged)


@pytest.mark.parametrize("kind", NO_FILES)
def test_non_regular_files_are_not_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "entry"
    assert read_cached(path) is None
    put_no_file(path, kind)
    with deadline(5):
        assert read_cached(path) is None


def test_a_cached_file_is_private_and_no_link(tmp_path: Path) -> None:
    path, elsewhere = tmp_path / "cache" / "entry", tmp_path / "elsewhere"
    write_cached(path, b"content")
    assert path.stat().st_mode & 0o777 == 0o600 and path.parent.stat().st_mode & 0o777 == 0o700
    assert read_cached(path) == b"content"
    path.chmod(0o660)
    assert read_cached(path) is None and not path.exists()
    elsewhere.write_bytes(digested(b"theirs"))
    path.symlink_to(elsewhere)
    assert read_cached(path) is None and elsewhere.exists()
    write_cached(path, b"content")
    assert read_cached(path) == b"content" and elsewhere.read_bytes() == digested(b"theirs")


def test_a_private_folder_is_this_users_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "above" / "cache"
    for mode in (None, 0o755):
        if mode:
            folder.chmod(mode)
        assert private_folder(folder).stat().st_mode & 0o777 == 0o700
    folder.chmod(0o770)
    with pytest.raises(OSError, match="others can write to it"):
        private_folder(folder)
    folder.chmod(0o700)
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(OSError, match="it is a symbolic link"):
        private_folder(tmp_path / "link")
    monkeypatch.setattr(disk.os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(OSError, match="it belongs to another user"):
        private_folder(folder)


@pytest.fixture
def settings_kept() -> Iterator[None]:
    """Restore JAX's settings."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_enable_x64")
    before = {name: jax.config.values[name] for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    runtime._TRACES.clear()


@pytest.mark.usefixtures("settings_kept")
def test_a_cache_that_others_can_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mjx-study").mkdir()
    monkeypatch.setattr("mjx_study.runtime.default_cache", lambda: tmp_path / "mjx-study")
    (tmp_path / "mjx-study").chmod(0o777)
    settings = {"precision": "float64", "cpu_devices": jax.local_device_count()}
    with pytest.raises(ValueError, match="cannot be kept in .*: others can write to it; give a folder"):
        configure(**settings, cache=tmp_path / "mjx-study")
    configure(**settings)
    assert traces_folder() is None and jax.config.values["jax_compilation_cache_dir"] is None
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mjx-study: compiled programs cannot be kept in") and "others can write to it" in line
    (tmp_path / "mjx-study").chmod(0o700)
    configure(**settings)
    assert traces_folder() == tmp_path / "mjx-study" / "traces"
    configure(**settings, cache="gs://bucket/cache")
    assert traces_folder() is None and jax.config.values["jax_compilation_cache_dir"] == "gs://bucket/cache"
