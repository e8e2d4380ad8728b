"""Where a trained agent is found: in a file, a folder, this package, or a repository on the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path

from torchrl.checkpoint import CheckpointError

from torchrl_ocwm.errors import MissingPackageError

#: The file of an agent in a folder or repository, whose README.md is its card.
AGENT_FILE, RUN_FILE = "agent.zip", "checkpoint.zip"
_SHIPPED = Path(__file__).parents[1] / "trained"
_HUB = "hf://"


def shipped_agents() -> list[str]:
    """Names of the trained agents that are installed with this package, for :func:`~torchrl_ocwm.load_agent`.

    Examples:
        >>> all("/" in name for name in shipped_agents())
        True
    """
    return sorted(file.parent.relative_to(_SHIPPED).as_posix() for file in _SHIPPED.glob(f"*/*/{AGENT_FILE}"))


def is_name(source: str | Path) -> bool:
    """Whether it names a trained agent that others have too: of this package, or on the Hugging Face Hub.

    Examples:
        >>> is_name("hf://owner/name"), is_name("outputs/checkpoint.zip")
        (True, False)
    """
    return str(source).startswith(_HUB) or str(source) in shipped_agents()


def agent_file(source: str | Path) -> Path:
    """The file of a trained agent.

    Args:
        source: A file; a folder that holds ``agent.zip``, or the ``checkpoint.zip`` of a run; a name of
            :func:`shipped_agents`; or ``hf://owner/name``, with ``@revision`` behind it if need be, which is downloaded
            once (needs ``huggingface_hub``).

    Raises:
        CheckpointError: if there is none.
        MissingPackageError: without ``huggingface_hub``.
    """
    if str(source).startswith(_HUB):
        return _in(_download(str(source)), str(source))
    path = Path(source)
    if path.is_dir():
        return _in(path, str(source))
    shipped = _SHIPPED / path / AGENT_FILE
    if path.exists() or not shipped.exists():
        _check(path)
        return path
    return shipped


def _in(folder: Path, source: str) -> Path:
    for name in (AGENT_FILE, RUN_FILE):
        if (folder / name).is_file():
            return folder / name
    raise CheckpointError(f"{source}: holds no {AGENT_FILE} and no {RUN_FILE}")


def _check(path: Path) -> None:
    if not path.exists():
        raise CheckpointError(
            f"{path}: no such checkpoint; trained agents that come with this package: {', '.join(shipped_agents())}"
        )


def _download(source: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
    except ImportError as error:
        raise MissingPackageError(
            f"{source} needs huggingface_hub, which is not installed: pip install 'torchrl-ocwm[hub]'"
        ) from error
    repository, _, revision = source.removeprefix(_HUB).partition("@")
    try:
        found = snapshot_download(repository, revision=revision or None, allow_patterns=[AGENT_FILE, RUN_FILE, "*.md"])
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError) as error:
        raise CheckpointError(f"{source}: cannot be downloaded ({' '.join(str(error).split())})") from error
    return Path(found)
