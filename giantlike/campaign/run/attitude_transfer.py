"""Attitudes from star images to the short exposures between them."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.observables import attitude_of, with_attitude
from giantlike.campaign.store.records import Attitude, AttitudeRecord, Problem
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import AttitudeSource
from giantlike.stars.rates import AngularRates, read_rates
from giantlike.stars.transfer import StarAttitude, TransferMethod, TransferredAttitude, transfer_attitude


def transfer_attitudes(campaign: Campaign, records: Sequence[AttitudeRecord]) -> list[AttitudeRecord]:
    """Give the short exposures of a campaign the attitudes of their neighbors in time."""
    if campaign.stars is None or campaign.stars.long_exposure_s is None:
        return list(records)
    donors = [(record, star) for record in records if (star := _star(record)) is not None]
    rates = None if campaign.stars.rates is None else read_rates(campaign.stars.rates)
    if campaign.stars.transfer.method is TransferMethod.PROPAGATE and rates is None:
        donors = [donor for donor in donors if donor[1].apriori is not None] or donors
    donors.sort(key=lambda donor: donor[1].et)
    times = [star.et for _, star in donors]
    transferred = []
    for record in records:
        if record.readable and not record.star_image:
            after = 0 if record.et is None else bisect.bisect_right(times, record.et)
            record = _transfer_attitude(campaign, record, donors[max(after - 1, 0) : after + 1], rates)
        transferred.append(record)
    return transferred


def attitude_to_use(campaign: Campaign, record: AttitudeRecord) -> Attitude | None:
    """Attitude for the estimators: the one found, else the a priori one; None without either."""
    if record.attitude is not None or record.apriori is None:
        return record.attitude
    return attitude_of(record.apriori, AttitudeSource.A_PRIORI, campaign.apriori_covariance_rad2(record.file))


def _star(record: AttitudeRecord) -> StarAttitude | None:
    """Star solution of an image as the transfer takes it; None if there is none."""
    attitude = record.attitude
    if attitude is None or record.et is None or attitude.covariance_rad2 is None:
        return None
    if attitude.source != AttitudeSource.STARS:
        return None
    return StarAttitude(
        et=record.et,
        camera_from_inertial=attitude.rotation,
        covariance_rad2=np.array(attitude.covariance_rad2),
        apriori=record.apriori,
        errors=attitude.errors,
    )


def _transfer_attitude(
    campaign: Campaign,
    record: AttitudeRecord,
    donors: Sequence[tuple[AttitudeRecord, StarAttitude]],
    rates: AngularRates | None,
) -> AttitudeRecord:
    """Record of a short exposure with the attitude that its neighbors give."""
    assert campaign.stars is not None
    options = campaign.stars.transfer
    record = record.replace(transferred=True)
    if record.et is None:
        outcome: TransferredAttitude | Failure = Failure(Reason.NO_EPOCH, "no epoch, so it has no neighbors in time")
    else:
        stars = [star for _, star in donors]
        outcome = transfer_attitude(record.et, stars, apriori=record.apriori, rates=rates, options=options)
    if isinstance(outcome, Failure):
        problem = Problem(reason=outcome.reason, detail=f"{record.file}: {outcome.detail}")
        return record.replace(
            status="failed", problem=problem, attitude=None, ra_deg=None, dec_deg=None, roll_deg=None, fov_deg=None
        )
    attitude = attitude_of(
        outcome.camera_from_inertial, AttitudeSource.INTERPOLATED, outcome.covariance_rad2, outcome.errors
    )
    sources = [donors[index][0] for index in outcome.used]
    suspect = any(not source.outcome.is_usable for source in sources)
    provenance = {
        "transfer": str(options.method),
        "from": ", ".join(source.file for source in sources),
        "gap_s": f"{outcome.gap_s:.6g}",
    }
    record = with_attitude(record, campaign.camera, attitude, "suspect" if suspect else "ok")
    shares = {source.file: weight for source, weight in zip(sources, outcome.weights, strict=True)}
    return record.replace(provenance=provenance, flags=list(outcome.errors.flags.names()), attitude_shares=shares)
