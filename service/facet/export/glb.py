"""glTF binary: the planar model as a scene, one node a surface, coloured by class, y up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from facet.export.colours import CLASS_COLOURS
from facet.export.triangles import inward_normal, surface_triangles
from facet_protocol.messages import Plane, PlaneClass, Surface


def write_glb(planes: Sequence[Plane], path: Path) -> None:
    """Nodes `wall-3-7` (class, plane, surface); the plane's figures stand in the meshes' extras."""
    scene = trimesh.Scene()
    materials = {kind: _material(kind) for kind in PlaneClass}
    for plane in planes:
        for surface in plane.surfaces:
            mesh = _mesh(plane, surface, materials[plane.plane_class])
            if len(mesh.faces):
                name = f"{plane.plane_class.value}-{plane.id}-{surface.id}"
                scene.add_geometry(mesh, node_name=name, geom_name=name)
    path.write_bytes(export_glb(scene, include_normals=True))  # type: ignore[no-untyped-call]


def _mesh(plane: Plane, surface: Surface, material: PBRMaterial) -> trimesh.Trimesh:
    xyz, faces = surface_triangles(plane, surface)
    visual = TextureVisuals(material=material)  # type: ignore[no-untyped-call]
    normals = np.broadcast_to(_to_gltf(inward_normal(plane)[None]), xyz.shape)
    return trimesh.Trimesh(
        vertices=_to_gltf(xyz),
        faces=faces.astype(np.int64),
        vertex_normals=normals,
        visual=visual,
        metadata={
            "plane_id": plane.id,
            "surface_id": surface.id,
            "class": plane.plane_class.value,
            "normal": plane.normal.tolist(),
            "d": plane.d,
            "sigma_n_m": plane.sigma_n_m,
            "area_m2": surface.area_m2,
        },
        process=False,
    )


def _to_gltf(p_world: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([p_world[:, 0], p_world[:, 2], -p_world[:, 1]], axis=1)


def _material(plane_class: PlaneClass) -> PBRMaterial:
    """Ceilings are one-sided, so that a viewer looks from above into the rooms."""
    return PBRMaterial(  # type: ignore[no-untyped-call]
        name=plane_class.value,
        baseColorFactor=[*CLASS_COLOURS[plane_class], 255],
        metallicFactor=0.0,
        roughnessFactor=0.9,
        doubleSided=plane_class is not PlaneClass.CEILING,
    )
