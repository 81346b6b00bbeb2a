"""A calibration in other programs' files: OpenCV's FileStorage and ROS' camera_info."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from endo3d.services.runtime.errors import UserError
from endo3d_core.calibration import Lens, Rig


def write_opencv(rig: Rig, path: Path) -> None:
    """Readable by ``cv2.FileStorage``; X_projector = R X_camera + T, mm. Raises ``UserError``."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise UserError(f"{path} can't be written; name a file ending in .yaml, .yml or .xml in an existing folder")
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        storage.write(f"{name}_image_size", np.array([lens.width, lens.height], np.int32))
        storage.write(f"{name}_matrix", lens.K)
        storage.write(f"{name}_distortion", lens.dist.reshape(1, 5))
    storage.write("R", rig.R)
    storage.write("T", rig.t.reshape(3, 1))
    storage.release()


def camera_info(lens: Lens, name: str, T_lens_camera: NDArray[np.float64] | None = None) -> str:
    """A file of ROS' camera_calibration_parsers (plumb_bob). ``T_lens_camera``: lengths become metres, in a comment."""
    P = np.hstack((lens.K, np.zeros((3, 1))))
    tree = {
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_name": name,
        "camera_matrix": _matrix(lens.K),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _matrix(lens.dist.reshape(1, 5)),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(P),
    }
    text = str(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None))
    if T_lens_camera is None:
        return text
    T = T_lens_camera.copy()
    T[:3, 3] *= 1e-3
    return f"# T_{name}_camera, m: {T.tolist()}\n{text}"


def write_camera_info(rig: Rig, folder: Path) -> list[Path]:
    """``camera.yaml`` and ``projector.yaml``; the files."""
    folder.mkdir(parents=True, exist_ok=True)
    camera, projector = folder / "camera.yaml", folder / "projector.yaml"
    camera.write_text(camera_info(rig.camera, "camera"), encoding="utf-8")
    projector.write_text(camera_info(rig.projector, "projector", rig.T_projector_camera), encoding="utf-8")
    return [camera, projector]


def _matrix(array: NDArray[np.float64]) -> dict[str, object]:
    return {"rows": array.shape[0], "cols": array.shape[1], "data": [float(v) for v in array.ravel()]}
