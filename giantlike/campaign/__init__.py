"""Campaigns: one TOML file in, a run folder with tables and a report out; names are imported when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from giantlike.campaign.file.config import Campaign
    from giantlike.campaign.plan.write import write_plan
    from giantlike.campaign.report.run_page import write_report
    from giantlike.campaign.run.runner import run_campaign
    from giantlike.campaign.store.results import RunResult, load_result
    from giantlike.campaign.store.run_photos import photos_of_run

_HOME_OF = {
    "Campaign": "file.config",
    "RunResult": "store.results",
    "load_result": "store.results",
    "photos_of_run": "store.run_photos",
    "run_campaign": "run.runner",
    "write_plan": "plan.write",
    "write_report": "report.run_page",
}

__all__ = ["Campaign", "RunResult", "load_result", "photos_of_run", "run_campaign", "write_plan", "write_report"]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'giantlike.campaign' has no attribute {name!r}")
    return getattr(import_module(f"giantlike.campaign.{_HOME_OF[name]}"), name)
