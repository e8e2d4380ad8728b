"""The package of somebody else."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchrl_ocwm.parts import VARIABLE, load_plugins

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def plugin(registries: None) -> Iterator[None]:
    """It can be found, and is gone afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(HERE)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(HERE), str(ROOT), os.environ.get("PYTHONPATH", "")]))
        patch.setenv(VARIABLE, "ocwm_example")
        load_plugins.cache_clear()
        yield
    for name in [name for name in sys.modules if name.split(".")[0] == "ocwm_example"]:
        del sys.modules[name]
    load_plugins.cache_clear()
