"""CAD models: triangle meshes from STL and PLY files, in mm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.runtime.errors import UserError


def load_mesh(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (n, 3) and faces (m, 3). Raises ``UserError`` that says what to do."""
    import trimesh

    try:
        mesh: Any = trimesh.load_mesh(path)
    except (OSError, ValueError, NotImplementedError) as error:
        raise UserError(f"the model {str(path)!r} can't be read: {error}; give an STL or PLY file, in mm") from error
    faces = np.asarray(getattr(mesh, "faces", ()), np.int64)
    if not len(faces):
        raise UserError(f"the model {str(path)!r} holds no triangles; export it as a mesh (STL or PLY), in mm")
    return np.asarray(mesh.vertices, np.float64), faces
