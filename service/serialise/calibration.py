"""The JSON of ``spheremark calibrate``: a calibration as plain values.

A public interface, and a rig file too: its ``rig`` is what ``--rig`` takes.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.calibration import Calibration
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.service.serialise.plain import Plain


def serialise_calibration(found: Calibration) -> Plain:
    """Return a calibration as plain values."""
    sigmas = np.sqrt(np.diag(found.cov))
    rows = zip(found.names, found.units, found.start_values, found.estimates, sigmas, strict=True)
    return {
        "rig": rig_to_mapping(found.rig),
        "rig_digest": rig_digest(found.rig),
        "start_rig_digest": rig_digest(found.start),
        "parameters": [
            {
                "name": name,
                "unit": unit,
                "start": float(start),
                "estimate": float(estimate),
                "sigma": float(sigma),
            }
            for name, unit, start, estimate, sigma in rows
        ],
        "covariance": found.cov.tolist(),
        "not_separable": [{"name": held.name, "reason": held.reason} for held in found.inseparable],
        "stops": list(found.stops),
        "n_spheres": found.n_spheres,
        "n_two_faced": found.n_two_faced,
        "n_returns": found.n_returns,
        "dof": found.dof,
        "sigma0": found.sigma0,
        "residual_rms_before_m": found.rms_before,
        "residual_rms_after_m": found.rms_after,
    }
