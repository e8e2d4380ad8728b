"""LeRobot datasets, versions 2 and 3: Parquet files, and videos beside them."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ocwm.data.formats.source import Source, SourceError
from torchrl_ocwm.data.formats.video import read_video
from torchrl_ocwm.envs.missing import needs


class LeRobotSource(Source):
    """The features of a LeRobot dataset in its documented layout; LeRobot itself is not needed.

    The recordings have no frame after the last action, so that this action is left out.

    Args:
        path: The folder of the dataset, with ``meta/info.json``.

    Raises:
        SourceError: if there is none, or one of another version.
        MissingPackageError: if pyarrow is missing, with the extra to install.
    """

    usual = {"proprio": "observation.state", "reward": "next.reward", "action": "action"}  # noqa: RUF012

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.folder = Path(path)
        try:
            self.info: dict[str, Any] = json.loads((self.folder / "meta" / "info.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise SourceError(f"{path}: no LeRobot dataset ({error})") from error
        self.version = str(self.info.get("codebase_version", ""))
        if not self.version.startswith(("v2.", "v3.")):
            raise SourceError(f"{path}: a LeRobot dataset of version {self.version!r}; v2.x and v3.x can be read")
        self.read_table = lru_cache(maxsize=2)(_read_table)
        self.episodes = self._episodes()

    def __len__(self) -> int:
        return len(self.episodes)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names of the features, each with the shape of a row."""
        return {name: tuple(feature["shape"]) for name, feature in self.info["features"].items()}

    def read(self, episode: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Arrays of an episode."""
        for name in names:
            if name not in self.info["features"]:
                raise self.lacks(episode, name)
        where = self.episodes[episode]
        return {name: self._read(where, name) for name in names}

    def _read(self, where: Mapping[str, Any], name: str) -> np.ndarray:
        feature = self.info["features"][name]
        if feature["dtype"] == "video":
            place = {"video_key": name, **_place(where, f"videos/{name}/")}
            start = where.get(f"videos/{name}/from_timestamp", 0.0)
            # Half a frame earlier, so that rounding cannot skip the first.
            start = max(0.0, start - 0.5 / self.info["fps"])
            return read_video(self.folder / self.info["video_path"].format(**place), start, where["length"])
        table = self.read_table(self.folder / self.info["data_path"].format(**_place(where, "data/")))
        rows = table["episode_index"].to_numpy() == where["episode_index"]
        column = table.filter(rows)[name]
        if feature["dtype"] == "image":
            return np.stack([_image(cell.as_py()) for cell in column])
        return np.asarray(column.to_pylist()).reshape(len(column), *feature["shape"])

    def _episodes(self) -> list[dict[str, Any]]:
        meta = self.folder / "meta"
        if self.version.startswith("v3."):
            rows = [row for file in sorted(meta.glob("episodes/**/*.parquet")) for row in _read_table(file).to_pylist()]
        else:
            lines = (meta / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
            rows = [json.loads(line) for line in lines if line.strip()]
            for row in rows:
                row["episode_chunk"] = row["episode_index"] // self.info["chunks_size"]
        return sorted(rows, key=lambda row: row["episode_index"])


def _place(where: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """What the templates of file names take, in either version."""
    of_file = {name.removeprefix(prefix): value for name, value in where.items() if name.startswith(prefix)}
    return {**{name: where[name] for name in ("episode_index", "episode_chunk") if name in where}, **of_file}


def _read_table(file: Path) -> Any:
    with needs("a LeRobot dataset", "import"):
        import pyarrow.parquet
    try:
        return pyarrow.parquet.read_table(file)
    except OSError as error:
        raise SourceError(f"{file}: cannot be read ({error})") from error


def _image(cell: Mapping[str, Any]) -> np.ndarray:
    with needs("reading images", "import"):
        import imageio.v3
    return imageio.v3.imread(io.BytesIO(cell["bytes"]))[..., :3]
