"""A calibration and how good it is, for the operator and for a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from station.calibration.solve import world
from station.calibration.solve.acceptance import HeldOut
from station.calibration.solve.refusals import SIGMAS_95
from station.calibration.solve.world import WorldPoses
from station.core.rig import Rig


@dataclass(frozen=True, slots=True)
class Solution:
    """A calibration and how good it is."""

    rig: Rig
    world_poses: WorldPoses
    """Poses with the covariance between cameras."""
    held_out: Mapping[str, HeldOut]
    weak: tuple[str, ...]
    """Advice on what could be better; empty where there is none."""
    clock_s: Mapping[str, float]
    """Offset of each camera's clock against the reference's."""
    radius_m: float
    """The ball's, as all cameras measured it."""

    def summary(self) -> list[str]:
        """Lines for the operator."""
        rms_mm = 1e3 * self.rig.residual_rms_m
        lines = [
            "the calibration can be used" if self.weak else "the calibration is good",
            "tested on a fifth of the seconds, which were left out at first: cameras see the ball "
            f"{rms_mm:.1f} mm apart (rms)",
        ]
        for name, one in self.held_out.items():
            shift_m, turn_rad = self._sigma(name)
            known = (
                "reference"
                if name == self.rig.reference
                else f"known to within {1e3 * shift_m:.1f} mm and "
                f"{np.degrees(turn_rad):.2f} degrees"
            )
            off_mm = 1e3 * float(np.linalg.norm(one.mean_m))
            lines.append(f"{name}: {known}; off by {off_mm:.1f} mm in {one.detections} tests")
        if self.rig.predicted is not None:
            lines.append(
                "from the calibration alone, heights are accurate to "
                f"{1e3 * SIGMAS_95 * self.rig.predicted.height_sigma_m:.1f} mm and girths to "
                f"{1e3 * SIGMAS_95 * self.rig.predicted.girth_sigma_m:.1f} mm (95 %)"
            )
            tilt_deg = np.degrees(self.rig.predicted.tilt_sigma_rad)
            lines.append(f"what is vertical is known to within {tilt_deg:.2f} degrees")
        return lines + [f"could be better: {words}" for words in self.weak]

    @property
    def report(self) -> dict[str, Any]:
        """For a JSON file beside the calibration."""
        names = list(self.world_poses.world_from_camera)
        return {
            "residual_rms_m": self.rig.residual_rms_m,
            "measured_radius_m": self.radius_m,
            "slope_sigma_rad": self.world_poses.slope_sigma_rad,
            "weak": list(self.weak),
            "cameras": {
                name: {
                    "held_out": self.held_out[name].detections,
                    "held_out_rms_m": self.held_out[name].rms_m,
                    "held_out_mean_m": self.held_out[name].mean_m.tolist(),
                    "sigma_to_reference_m": self._sigma(name)[0],
                    "sigma_to_reference_rad": self._sigma(name)[1],
                    "clock_offset_s": self.clock_s[name],
                }
                for name in names
            },
            "joint_covariance": {"cameras": names, "xi": self.world_poses.covariance.tolist()},
        }

    def _sigma(self, name: str) -> tuple[float, float]:
        return world.pose_sigma(self.world_poses, self.rig.reference, name)
