"""The joint covariance of a setup's calibrated values as recording.toml holds it."""

from arctrack.recording import CalibrationValues
from arctrack.recording.setup_writer import CERTIFICATE, GEOMETRY
from arctrack.recording.toml_text import rounded
from calibration.certificate import Certificate
from noise_model.calibration_errors import CalibrationCovariance


def geometry_records(
    covariance: CalibrationCovariance, certificate: Certificate, made_by: str
) -> tuple[CalibrationValues, ...]:
    """Return both for a setup: by the covariance a track has its sigma, the certificate is for people."""
    n = certificate.nearest_to_tool
    pose_mm = certificate.pose_sigma_mm[n, 1:].tolist()
    return (
        CalibrationValues("camera", {}, covariance.names, covariance.matrix, made_by, name=GEOMETRY),
        CalibrationValues(
            "camera",
            {},
            ("seam_y_mm", "seam_z_mm"),
            certificate.covariance_mm2[n][1:, 1:],
            made_by,
            {"robot_pose_sigma_mm": [rounded(value, 3) for value in pose_mm]},
            CERTIFICATE,
        ),
    )
