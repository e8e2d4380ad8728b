"""TorchRL's checkpoints in one file, which is whole at any moment."""

from __future__ import annotations

import os
import shutil
import textwrap
import zipfile
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from torchrl_ocwm.files import replacing, sync

_REASON = 300  # characters of what PyTorch says at most


@runtime_checkable
class HasStateDict(Protocol):
    """What a checkpoint keeps as a state dict."""

    def state_dict(self) -> Any:
        """Its state."""

    def load_state_dict(self, state_dict: Any) -> Any:
        """Take a state."""


class Archive(Checkpoint):
    """TorchRL's :class:`~torchrl.checkpoint.Checkpoint` as one file that a kill, a full disk or a power cut spares.

    The new file is written beside the one before, reaches the disk, and takes its place in one step.

    Args:
        metadata: Kept in the file's manifest (:func:`read_manifest`); must fit in JSON.
        any_version: Do not warn of a file that another PyTorch wrote, as what it holds is checked by name and shape.
        components: What to keep, by name.

    Examples:
        >>> import tempfile, torch
        >>> file = tempfile.mkdtemp() + "/layer.zip"
        >>> _ = Archive(metadata={"colour": "red"}, layer=torch.nn.Linear(1, 1)).save(file)
        >>> read_manifest(file)["metadata"]
        {'colour': 'red'}
    """

    def __init__(self, *, metadata: dict[str, Any] | None = None, any_version: bool = False, **components: Any) -> None:
        super().__init__(format="archive", **components)
        self.metadata, self.any_version = metadata or {}, any_version
        # TorchRL's own choice writes memory-mapped files, and a disk that fills up under them kills the process.
        self.register_adapter(HasStateDict, StateDictCheckpointAdapter("archive"))

    def save(self, path: str | Path, **options: Any) -> Path:  # type: ignore[override]
        """Write the checkpoint; the one before stays until the new one is whole.

        Raises:
            CheckpointError: if it cannot be written.
        """
        path = Path(path)
        stage = path.with_name(f".{path.name}.stage")
        try:
            shutil.rmtree(stage, ignore_errors=True)  # a kill may have left it
            with replacing(path) as new:
                os.replace(super().save(stage / path.name, **{"metadata": self.metadata, **options}), new)
        except (OSError, RuntimeError) as error:  # PyTorch's own files raise the second
            kept = f"the checkpoint before it is kept at {path}" if path.exists() else "there was none before it"
            reason = getattr(error, "strerror", None) or error
            raise CheckpointError(f"cannot write the checkpoint {path} ({reason}); {kept}") from error
        finally:
            shutil.rmtree(stage, ignore_errors=True)
        return path

    def load(self, path: str | Path, **options: Any) -> Any:  # type: ignore[override]
        """Restore the registered components.

        Raises:
            CheckpointError: if the file cannot be read, lacks a component, or holds one that does not fit.
        """
        try:
            return super().load(path, **options)
        except (CheckpointError, OSError) as error:
            reason = textwrap.shorten(str(error), _REASON, placeholder=" …")  # PyTorch names each weight
            raise CheckpointError(f"{path}: cannot be loaded ({reason})") from error

    def _compare_versions(self, manifest_versions: object) -> dict[str, Any]:  # type: ignore[override]
        return {} if self.any_version else Checkpoint._compare_versions(manifest_versions)


def read_manifest(path: str | Path) -> dict[str, Any]:
    """What a checkpoint says of itself, after all of the file has been checked against its checksums.

    Raises:
        CheckpointError: if there is none, or it is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise CheckpointError(f"{path}: no such checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged, members = archive.testzip(), set(archive.namelist())
        manifest = Checkpoint.manifest(path)
    except Exception as error:  # whatever a file that is no checkpoint, or a damaged one, makes the readers raise
        raise CheckpointError(f"{path}: not a checkpoint of TorchRL, or damaged ({error})") from error
    records = manifest["components"].values()
    lost = {f"{record['path']}/{file}" for record in records for file in record["files"]} - members
    if damaged or lost:
        raise CheckpointError(f"{path}: damaged ({damaged or min(lost)} in it); use a copy, or train again")
    return manifest


def recover(path: Path) -> None:
    """Put right what a kill during a save left: take a whole backup for a checkpoint that is gone, and clear the rest.

    Nobody else may be writing the checkpoint meanwhile.
    """
    for leftover in [*path.parent.glob(f".{path.name}.stage*"), *path.parent.glob(f".{path.name}.archive-*")]:
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    # TorchRL's own save has a moment in which only the backup is there.
    backups = sorted(path.parent.glob(f".{path.name}.backup-*"), key=lambda file: file.stat().st_mtime, reverse=True)
    for backup in filter(_is_whole, backups):
        if _is_whole(path):
            backup.unlink()
        else:
            os.replace(backup, path)
            sync(path.parent)


def _is_whole(path: Path) -> bool:
    try:
        read_manifest(path)
    except CheckpointError:
        return False
    return True
