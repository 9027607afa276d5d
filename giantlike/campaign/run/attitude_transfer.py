"""Attitudes from star images to the short exposures between them."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.store.observables import attitude_fields, attitude_value, rotation_of
from giantlike.campaign.store.records import Attitude, AttitudeRecord, Problem
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import AttitudeSource
from giantlike.stars.rates import AngularRates, read_rates
from giantlike.stars.transfer import StarAttitude, TransferMethod, TransferOptions, transfer_attitude

_NOT_FOUND = {"attitude": None, "ra_deg": None, "dec_deg": None, "roll_deg": None, "fov_deg": None}


def carry_attitudes(campaign: Campaign, records: Sequence[AttitudeRecord]) -> list[AttitudeRecord]:
    """Give the short exposures of a campaign the attitudes of their neighbors in time.

    Parameters
    ----------
    campaign : Campaign
    records : sequence of AttitudeRecord
        Of all images, star images solved.

    Returns
    -------
    list of AttitudeRecord
        In the same order; a short exposure that gets no attitude has failed.
    """
    if campaign.stars is None or campaign.stars.long_exposure_s is None:
        return list(records)
    options = campaign.stars.transfer
    donors = [(record, star) for record in records if (star := _star(record)) is not None]
    rates = None if campaign.stars.rates is None else read_rates(campaign.stars.rates)
    if options.method is TransferMethod.PROPAGATE and rates is None:
        donors = [donor for donor in donors if donor[1].apriori is not None] or donors
    donors.sort(key=lambda donor: donor[1].et)
    times = [star.et for _, star in donors]
    carried = []
    for record in records:
        if record.readable and not record.star_image:
            after = 0 if record.et is None else bisect.bisect_right(times, record.et)
            neighbors = donors[max(after - 1, 0) : after + 1]
            carried.append(_carried(campaign, record, neighbors, options, rates))
        else:
            carried.append(record)
    return carried


def attitude_to_use(record: AttitudeRecord) -> Attitude | None:
    """What estimators are to take: the attitude found, else the a priori one, else none."""
    if record.attitude is not None or record.apriori_xyzw is None:
        return record.attitude
    return attitude_value(Rotation.from_quat(record.apriori_xyzw), AttitudeSource.A_PRIORI)


def _star(record: AttitudeRecord) -> StarAttitude | None:
    attitude = record.attitude
    if attitude is None or record.et is None or attitude.covariance_rad2 is None:
        return None
    if attitude.source != AttitudeSource.STARS:
        return None
    return StarAttitude(
        et=record.et,
        camera_from_inertial=rotation_of(attitude),
        covariance_rad2=np.array(attitude.covariance_rad2),
        apriori=_apriori(record),
    )


def _apriori(record: AttitudeRecord) -> Rotation | None:
    return None if record.apriori_xyzw is None else Rotation.from_quat(record.apriori_xyzw)


def _carried(
    campaign: Campaign,
    record: AttitudeRecord,
    donors: Sequence[tuple[AttitudeRecord, StarAttitude]],
    options: TransferOptions,
    rates: AngularRates | None,
) -> AttitudeRecord:
    if record.et is None:
        problem = Problem(reason=Reason.NO_EPOCH, detail=f"{record.file}: no epoch, so it has no neighbors in time")
        return record.model_copy(update=_NOT_FOUND | {"transferred": True, "status": "failed", "problem": problem})
    stars = [star for _, star in donors]
    outcome = transfer_attitude(record.et, stars, apriori=_apriori(record), rates=rates, options=options)
    if isinstance(outcome, Failure):
        problem = Problem(reason=outcome.reason, detail=f"{record.file}: {outcome.detail}")
        return record.model_copy(update=_NOT_FOUND | {"transferred": True, "status": "failed", "problem": problem})
    attitude = attitude_value(outcome.camera_from_inertial, AttitudeSource.INTERPOLATED, outcome.covariance_rad2)
    sources = [donors[index][0] for index in outcome.used]
    suspect = any(source.status == "suspect" for source in sources)
    provenance = {
        "transfer": str(options.method),
        "from": ", ".join(source.file for source in sources),
        "gap_s": f"{outcome.gap_s:.6g}",
    }
    fields = attitude_fields(campaign.camera, attitude) | {
        "transferred": True,
        "problem": None,
        "provenance": provenance,
        "status": "suspect" if suspect else "ok",
    }
    return record.model_copy(update=fields)
