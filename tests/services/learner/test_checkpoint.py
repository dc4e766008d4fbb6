"""A checkpoint is whole or does not exist, whatever befalls the disk or the process."""

import errno
import json
import os
from pathlib import Path

import pytest

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.model.weights_files import read_weights, write_weights
from mrcdrl.common.runtime.files import atomic_write
from mrcdrl.services.learner.checkpoint import Checkpoint, latest, load, load_latest, save
from mrcdrl.services.learner.learner import LearnerState


def make_checkpoint(step: int = 5, *, epoch: int = 1, version: int | None = None) -> Checkpoint:
    return Checkpoint(
        state=LearnerState(
            learner_step=step,
            model=f"model {step}".encode() * 1000,
            target=f"target {step}".encode() * 1000,
            optimizer=f"optimizer {step}".encode() * 1000,
            rng_state={"state": {"state": 2**127 + step}, "bit_generator": "PCG64"},
        ),
        weights_epoch=epoch,
        weights_version=step // 5 if version is None else version,
        config_digest="abc",
        unix_time_s=1234.5,
    )


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    directory = tmp_path / "run" / "checkpoints"
    assert load_latest(directory) is None
    assert latest(directory) is None
    path = save(directory, make_checkpoint(1234), keep=3)
    assert path.name == "step_000001234"
    assert names(path) == [
        "manifest.json",
        "model.safetensors",
        "optimizer.safetensors",
        "target.safetensors",
    ]
    assert load(path) == make_checkpoint(1234)
    loaded = load_latest(directory)
    assert loaded is not None
    assert (loaded.path, loaded.checkpoint, loaded.skipped) == (path, load(path), ())


def test_the_newest_are_kept(tmp_path: Path) -> None:
    for step in (5, 10, 15, 20):
        save(tmp_path, make_checkpoint(step), keep=2)
    assert names(tmp_path) == ["step_000000015", "step_000000020"]
    with pytest.raises(ValueError, match="keep"):
        save(tmp_path, make_checkpoint(25), keep=0)


def test_a_new_epoch_is_newer_than_more_steps(tmp_path: Path) -> None:
    save(tmp_path, make_checkpoint(500), keep=2)
    newer = save(tmp_path, make_checkpoint(5, epoch=2, version=101), keep=2)
    assert latest(tmp_path) == newer


def test_the_same_step_is_replaced(tmp_path: Path) -> None:
    save(tmp_path, make_checkpoint(5, version=1), keep=2)
    path = save(tmp_path, make_checkpoint(5, version=2), keep=2)
    assert load(path).weights_version == 2
    assert names(tmp_path) == ["step_000000005"]


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def remove(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("damage", [flip, cut, remove])
@pytest.mark.parametrize(
    "name", ["model.safetensors", "target.safetensors", "optimizer.safetensors", "manifest.json"]
)
def test_a_damaged_checkpoint_is_skipped_and_named(tmp_path, damage, name) -> None:  # type: ignore[no-untyped-def]
    older = save(tmp_path, make_checkpoint(5), keep=3)
    newer = save(tmp_path, make_checkpoint(10), keep=3)
    damage(newer / name)
    if name == "manifest.json" and damage is flip:
        (newer / name).write_bytes(b"{")
    with pytest.raises(CheckpointError, match="step_000000010") as caught:
        load(newer)
    assert "\n" not in str(caught.value)
    loaded = load_latest(tmp_path)
    assert loaded is not None
    assert loaded.path == older
    assert loaded.checkpoint == make_checkpoint(5)
    if name != "manifest.json":
        assert len(loaded.skipped) == 1
        assert name in loaded.skipped[0]


def test_with_damaged_ones_only_nobody_starts_anew_unawares(tmp_path: Path) -> None:
    path = save(tmp_path, make_checkpoint(), keep=3)
    flip(path / "model.safetensors")
    with pytest.raises(CheckpointError, match="none of 1 checkpoints is whole"):
        load_latest(tmp_path)


@pytest.mark.parametrize("change", [{"format_version": 2}, {"learner_step": "x"}, {"rng_state": 1}])
def test_a_foreign_manifest_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    path = save(tmp_path, make_checkpoint(), keep=3)
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | change))
    with pytest.raises(CheckpointError):
        load(path)


class Killed(BaseException):
    """The process ends here: no handler of ours may run to tidy up."""


@pytest.mark.parametrize("call", range(15))
def test_killed_at_any_system_call_the_older_one_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    save(tmp_path, make_checkpoint(5), keep=3)
    count = 0

    def dying(real):  # type: ignore[no-untyped-def]
        def run(*args, **options):  # type: ignore[no-untyped-def]
            nonlocal count
            count += 1
            if count > call:
                raise Killed
            return real(*args, **options)

        return run

    with monkeypatch.context() as patch:
        for name in ("open", "write", "fsync"):
            patch.setattr(os, name, dying(getattr(os, name)))
        patch.setattr(Path, "rename", dying(Path.rename))
        with pytest.raises(Killed):
            save(tmp_path, make_checkpoint(10), keep=3)
    loaded = load_latest(tmp_path)
    assert loaded is not None
    assert loaded.checkpoint == make_checkpoint(5)
    assert loaded.skipped == ()
    save(tmp_path, make_checkpoint(15), keep=3)
    assert names(tmp_path) == ["step_000000005", "step_000000015"], "leftovers are removed"


@pytest.mark.parametrize("name", ["write", "fsync"])
@pytest.mark.parametrize("calls_before", [0, 1, 3])
def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, calls_before: int
) -> None:
    save(tmp_path, make_checkpoint(5), keep=1)
    real, count = getattr(os, name), 0

    def full(*args):  # type: ignore[no-untyped-def]
        nonlocal count
        count += 1
        if count > calls_before:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, full)
        with pytest.raises(CheckpointError, match="No space left on device") as caught:
            save(tmp_path, make_checkpoint(10), keep=1)
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == ["step_000000005"]
    assert load_latest(tmp_path) is not None


def test_no_permission_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(CheckpointError, match="Permission denied"):
        save(tmp_path, make_checkpoint(), keep=1)


def test_a_short_write_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: real(fd, bytes(data[:7])))
    atomic_write(tmp_path / "file", b"0123456789" * 5)
    assert (tmp_path / "file").read_bytes() == b"0123456789" * 5


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "best.safetensors"
    write_weights(path, b"old", {"success_rate": 0.5})

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(CheckpointError, match="No space left"):
            write_weights(path, b"new", {"success_rate": 0.9})
    payload, manifest = read_weights(path)
    assert (payload, manifest["success_rate"]) == (b"old", 0.5)
    assert names(tmp_path) == ["best.json", "best.safetensors"]


def test_a_writer_that_is_killed_between_its_files_leaves_the_old_weights_and_what_is_known_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "best.safetensors"
    for rate, payload in enumerate((b"oldest", b"old")):
        write_weights(path, payload, {"success_rate": rate})

    def killed_before_the_payload(target: Path, content: bytes) -> None:
        if target == path:
            raise KeyboardInterrupt
        atomic_write(target, content)

    with monkeypatch.context() as patch:
        patch.setattr("mrcdrl.common.model.weights_files.atomic_write", killed_before_the_payload)
        with pytest.raises(KeyboardInterrupt):
            write_weights(path, b"new", {"success_rate": 2})
    payload, manifest = read_weights(path)
    assert (payload, manifest["success_rate"]) == (b"old", 1)
    assert "replaced" not in manifest
    write_weights(path, b"new", {"success_rate": 2})
    assert read_weights(path)[1]["success_rate"] == 2


def test_kept_weights_come_with_what_is_known_of_them_and_of_no_others(tmp_path: Path) -> None:
    path = tmp_path / "best.safetensors"
    write_weights(path, b"payload", {"version": 7})
    assert read_weights(path)[1]["version"] == 7
    atomic_write(path, b"newer")
    with pytest.raises(CheckpointError, match=r"damaged: .* not that of best\.json"):
        read_weights(path)
    path.with_suffix(".json").unlink()
    assert read_weights(path) == (b"newer", {})
    with pytest.raises(CheckpointError, match="No such file"):
        read_weights(tmp_path / "none.safetensors")
