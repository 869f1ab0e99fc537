"""A flight as a CCSDS Orbit Ephemeris Message (502.0-B-2), by the `oem` package. GMAT, STK and Orekit read it.

The frame is TOD, the true equator and equinox of date. Its z axis is the Earth's axis, as in our frame. The true
sidereal time of the epoch and the launch site's longitude turn our x axis into that of TOD. We take UT1 as UTC. The
difference is less than 0.9 s, which is 0.4 km at the launch site.
"""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from exports.extras import need
from exports.track import Track, turned


def oem_bytes(track: Track, epoch: datetime, launch_longitude: float) -> bytes:
    """The file, in km and km/s. epoch is the moment of lift-off (UTC), launch_longitude is in degrees east.

    Raises BadInput if the `oem` package is not installed.
    """
    need("--oem", "oem")
    from astropy.time import Time
    from oem import OrbitEphemerisMessage
    from oem.components import EphemerisSegment, HeaderSection, MetaDataSection

    angle = sidereal_time(epoch) + np.radians(launch_longitude)
    r, v = (turned(vectors, angle) / 1e3 for vectors in (track.r, track.v))
    moments = [iso(epoch + timedelta(seconds=t)) for t in track.t]
    metadata = {
        "OBJECT_NAME": track.name,
        "OBJECT_ID": track.name,
        "CENTER_NAME": "EARTH",
        "REF_FRAME": "TOD",
        "TIME_SYSTEM": "UTC",
        "START_TIME": moments[0],
        "STOP_TIME": moments[-1],
        "INTERPOLATION": "HERMITE",
        "INTERPOLATION_DEGREE": "3",
    }
    header = {"CCSDS_OEM_VERS": "2.0", "CREATION_DATE": iso(datetime.now(UTC)), "ORIGINATOR": "PPO-GTRXL"}
    times: Any = Time(moments, format="isot", scale="utc", precision=6)
    segment = EphemerisSegment(MetaDataSection(metadata, "2.0"), (list(times), *r.T, *v.T), version="2.0")
    message = OrbitEphemerisMessage(HeaderSection(header), [segment])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.oem"
        message.save_as(path)
        return path.read_bytes()


def sidereal_time(epoch: datetime) -> float:
    """Greenwich apparent sidereal time of an epoch (UTC): the angle (rad) from true equinox to prime meridian."""
    import erfa
    from astropy.time import Time

    utc: Any = Time(iso(epoch), format="isot", scale="utc")
    tt = utc.tt
    return float(erfa.gst06a(utc.jd1, utc.jd2, tt.jd1, tt.jd2))


def iso(moment: datetime) -> str:
    """A moment to the microsecond, without its zone."""
    return moment.replace(tzinfo=None).isoformat(timespec="microseconds")
