"""What ``calibration.yaml`` says of itself: formulas, frames, units and what its sigmas hold."""

from l2m_gtsam.records.calibration import Uncertainty

UNCERTAINTY = {
    Uncertainty.FULL: (
        "sigmas carry the map's errors as they are: shared by readings near each other and by all "
        "sensors; they hold as far as the map explains its own field (`l2m map info`)"
    ),
    Uncertainty.INDEPENDENT: (
        "sigmas count the map's errors as independent from reading to reading; where the map is "
        "less sure than the sensor they are too small"
    ),
}

MODEL = {
    "measurement": "B_meas = C @ B_lidar + H",
    "correction": "B_lidar = inv(C) @ (B_meas - H)",
    "units": {"B": "uT", "H": "uT", "C": "1", "t": "m", "rotation": "rad", "noise": "uT"},
    "frames": "lidar: frame of the poses' child after the fixed transform; mag: the sensor's axes",
    "t_lidar_mag": "position of the sensor in the lidar frame",
    "rotation": (
        "C = R_mag_lidar @ P with P symmetric positive (proper polar factor); "
        "R_lidar_mag is its transpose; quaternions are x, y, z, w"
    ),
    "rotation_covariance": "of the error e in the mag frame: true = exp(e) @ R_mag_lidar",
    "covariance_order": "t_x t_y t_z C_xx C_xy C_xz C_yx C_yy C_yz C_zx C_zy C_zz H_x H_y H_z",
    "time_offset": (
        "a reading's pose is that at stamp + seconds; cross_covariance with the parameters in "
        "covariance_order; held says why it is not estimated but taken as 0"
    ),
    "moving": (
        "B_meas = C @ B_lidar + H + sum of number * h (uT per unit of the recorded number); H is "
        "the offset where all numbers are 0; empty where the readings do not ask for it"
    ),
    "models": (
        "models of the readings, z = C b + H + sum of number * h + E db/dt and parts of it; score: "
        "mean log density of held-out readings (1/uT^3), behind: the best of them; coefficients "
        "are those of the recommended model at t_lidar_mag, b counted as exact"
    ),
    "disagreements": (
        "stretches over which readings fit neither map nor distortion and were rejected: stamps in "
        "ns, the lidar's way from p_from to p_to in m in the map, median residual (size) in uT"
    ),
    "from_priors": (
        "what the readings leave open and only `calibration.priors` determine, or mostly (sigmas "
        "without them would be more than twice as large): parameters, and what was known of them"
    ),
    "infinite": "a variance of .inf marks what this drive and map do not determine",
}
