"""A flight as CZML, which Cesium plays: the vehicle, its path, and a label that names the burn.

Altitude and latitude over our spherical Earth are written as height and geodetic latitude over Cesium's ellipsoid. So
the flight begins on the ground.
"""

from __future__ import annotations

import json
from datetime import datetime, timedelta

import numpy as np

from exports.track import Track, over_ground

SPEED_UP = 20  # seconds of the flight in a second of the screen
GREEN, WHITE = [57, 211, 83, 255], [255, 255, 255, 255]


def czml_bytes(track: Track, epoch: datetime, launch_longitude: float) -> bytes:
    """The file. epoch is the moment of lift-off (UTC), launch_longitude is in degrees east."""
    ground = over_ground(track, launch_longitude)
    # rounded as in `stamp`: Cesium shows nothing between the last sample and an interval's end that is rounded up
    t = np.array([timedelta(seconds=seconds).total_seconds() for seconds in track.t.tolist()])
    interval = f"{stamp(epoch, 0.0)}/{stamp(epoch, t[-1])}"
    samples = np.column_stack([t, ground["longitude_deg"], ground["latitude_deg"], ground["altitude_m"]])
    document = {
        "id": "document",
        "name": track.name,
        "version": "1.0",
        "clock": {
            "interval": interval,
            "currentTime": stamp(epoch, 0.0),
            "multiplier": SPEED_UP,
            "range": "CLAMPED",
        },
    }
    position = {
        "epoch": stamp(epoch, 0.0),
        "interpolationAlgorithm": "LAGRANGE",
        "interpolationDegree": 2,
        "forwardExtrapolationType": "HOLD",
        "cartographicDegrees": samples.ravel().tolist(),
    }
    vehicle = {
        "id": track.name,
        "availability": interval,
        "position": position,
        "point": {"pixelSize": 8, "color": {"rgba": GREEN}},
        "path": {"width": 2, "leadTime": 0, "material": {"solidColor": {"color": {"rgba": GREEN}}}},
        "label": {
            "text": labels(track, epoch),
            "font": "14px sans-serif",
            "fillColor": {"rgba": WHITE},
            "pixelOffset": {"cartesian2": [12, -12]},
            "horizontalOrigin": "LEFT",
        },
    }
    return (json.dumps([document, vehicle], indent=1) + "\n").encode()


def labels(track: Track, epoch: datetime) -> list[dict]:
    """The label from each event to the next: what happened last."""
    begins = [t for t, _ in track.events]
    ends = [*begins[1:], float(track.t[-1])]
    return [
        {"interval": f"{stamp(epoch, begin)}/{stamp(epoch, end)}", "string": name}
        for (begin, name), end in zip(track.events, ends)
    ]


def stamp(epoch: datetime, t: float) -> str:
    """The moment t seconds after the epoch, ISO 8601 in UTC."""
    return (epoch + timedelta(seconds=t)).replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"
