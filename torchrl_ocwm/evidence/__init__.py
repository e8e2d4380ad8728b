"""The paper's tables and figures from a command each: their runs as data, a queue that does what is missing, a page.

Needs the extra ``recipes``.
"""

from torchrl_ocwm.evidence.datasets import Collected, Data, Drawn, Explored
from torchrl_ocwm.evidence.earlier import include
from torchrl_ocwm.evidence.estimate import Forecast, forecast, table
from torchrl_ocwm.evidence.figures import FIGURES, Figure, Row
from torchrl_ocwm.evidence.launchers import LAUNCHERS, Launcher
from torchrl_ocwm.evidence.page import write_page
from torchrl_ocwm.evidence.plan import Result, results
from torchrl_ocwm.evidence.queue import RunFailedError, in_order, to_do, work_off
from torchrl_ocwm.evidence.records import Record, RecordError
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Evidence, Machine
from torchrl_ocwm.evidence.setups import BUDGETS, SETUPS, Budget, Setup
from torchrl_ocwm.evidence.share import share
from torchrl_ocwm.evidence.trainings import Evaluated, Trained

__all__ = [
    "BUDGETS",
    "FIGURES",
    "LAUNCHERS",
    "SETUPS",
    "Budget",
    "Collected",
    "Data",
    "Drawn",
    "Evaluated",
    "Evidence",
    "Explored",
    "Figure",
    "Forecast",
    "Launcher",
    "Machine",
    "Record",
    "RecordError",
    "Result",
    "Row",
    "Run",
    "RunFailedError",
    "Setup",
    "Trained",
    "forecast",
    "in_order",
    "include",
    "results",
    "share",
    "table",
    "to_do",
    "work_off",
    "write_page",
]
