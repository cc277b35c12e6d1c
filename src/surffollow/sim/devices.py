"""Two small simulated resources beside a robot: a camera that pans, and a speaker."""

from __future__ import annotations

import math

CAMERA_RATE_RADPS = 1.0  # of a pan head of that time
CAMERA_RANGE_RAD = math.pi / 2
AUDIBLE_HZ = (20.0, 20_000.0)


class PanCamera:
    """A camera on a pan head that turns at a limited rate.

    Attributes
    ----------
    pan_rad : float   where it looks, 0: ahead, left positive
    moving : bool     it has not reached its target angles
    """

    def __init__(self) -> None:
        self.pan_rad, self.moving = 0.0, False

    def step(self, desired_rad: float, dt_s: float) -> None:
        """Turn toward an angle for a while."""
        desired_rad = min(max(desired_rad, -CAMERA_RANGE_RAD), CAMERA_RANGE_RAD)
        most = CAMERA_RATE_RADPS * dt_s
        self.pan_rad += min(max(desired_rad - self.pan_rad, -most), most)
        self.moving = abs(desired_rad - self.pan_rad) > 1e-9


class Speaker:
    """A speaker that sounds one tone at a time; zero, or an inaudible frequency, is silence.

    Attributes
    ----------
    tone_hz : float   what sounds, 0: nothing
    tones : int       tones begun so far
    """

    def __init__(self) -> None:
        self.tone_hz, self.tones = 0.0, 0

    def step(self, desired_hz: float, dt_s: float) -> None:
        """Sound a tone for a while."""
        tone_hz = desired_hz if AUDIBLE_HZ[0] <= desired_hz <= AUDIBLE_HZ[1] else 0.0
        self.tones += tone_hz != 0.0 and tone_hz != self.tone_hz
        self.tone_hz = tone_hz
