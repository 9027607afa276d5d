"""Campaigns: one TOML file in, a run folder with tables and a report out.

``run_campaign(Campaign.load("campaign.toml"))`` is what ``giantlike run`` does.
"""

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.results import RunResult, load_result

__all__ = ["Campaign", "RunResult", "load_result", "run_campaign", "write_report"]
