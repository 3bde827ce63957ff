"""Covariates of made-up frames, for residuals whose cause is known."""

import numpy as np

from sim_to_real.fit.covariates import UNITS, Covariates


def planted(n_frames=24, shape=(24, 32), seed=0):
    """Covariates of made-up frames: arc light that falls off aside, a stripe across, every bin counted."""
    draw = np.random.default_rng(seed)
    n = shape[0] * shape[1]
    row, column = (np.tile(part.ravel(), n_frames).astype(np.float32) for part in np.indices(shape))
    frame = np.repeat(np.arange(n_frames), n)
    arc_on, laser_on = frame % 6 >= 2, ~np.isin(frame % 6, (0, 2))
    current = np.where(arc_on, np.where(frame % 3 == 0, 140.0, 100.0), 0.0)
    place = 30.0 * draw.random(n_frames)[frame]
    distance = 20.0 + np.hypot(column - place, 0.7 * row)
    arc_dn = np.where(arc_on, current / 100.0 * 2e5 / distance**2.2, 0.0)
    beside_stripe = row - 8.0 - 6.0 * draw.random(n_frames)[frame]
    in_stripe = laser_on & (np.abs(beside_stripe) < 3.0)
    laser_dn = np.where(in_stripe, 60.0 * (1.0 + 0.3 * np.sin(column / 6.0)), 0.0)
    angles = {name: 20.0 + 40.0 * draw.random(len(frame)) for name in UNITS if UNITS[name] == "deg"}
    radius = np.hypot(row - shape[0] / 2.0, column - shape[1] / 2.0)
    values = angles | {
        "distance": np.where(arc_on, distance, np.nan),
        "field_angle": radius / 5.0,
        "gray_level": 4.0 + arc_dn + laser_dn,
        "exposure": np.where(frame % 5 == 0, 0.0025, 0.005),
        "current": current,
        "time": 0.1 * frame,
        "velocity_sign": np.sign(np.sin(frame * 0.9)),
        "concavity": np.where(column < 10, 0.4, 0.0),
        "beside_sheet": 0.8 * beside_stripe,
        "row": row,
        "column": column,
        "radius": radius,
    }
    return Covariates(
        shape,
        {name: values[name].astype(np.float32) for name in UNITS},
        frame.astype(np.int32),
        np.tile(np.arange(n, dtype=np.int32), n_frames),
        (laser_on + 2 * arc_on).astype(np.int8),
        in_stripe,
        np.ones(len(frame), dtype=np.float32),
        arc_dn.astype(np.float32),
        laser_dn.astype(np.float32),
        values["gray_level"].astype(np.float32),
        np.column_stack([row + 0.8 * frame, column]).astype(np.float32),
        np.zeros(len(frame), dtype=np.int32),
        np.zeros((len(frame), 6), dtype=np.float32),
    )
