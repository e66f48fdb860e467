"""What others do with a cloud of voxel centroids: normals and planes of Open3D and of CGAL."""

from __future__ import annotations

import ctypes
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
MOST_NORMALS_DEG = 25.0  # a point's normal against its shape's: CGAL's own default
REACH = 3.0  # voxels between points of one cluster of a RANSAC plane
MIN_AREA_M2 = 0.25  # of the smallest shape, as in Facet
OPEN3D_NEIGHBOURS = 30  # its own default
MIN_EDGE_M = 0.2  # of a patch; its default is a share of the map


@dataclass(frozen=True, eq=False)
class Cloud:
    """Centroids (V, 3) m with normals (V, 3) unit, and the voxels they stand for."""

    centroids: Float
    normals: Float
    voxel_m: float

    @property
    def min_points(self) -> int:
        """Voxels of the smallest shape that Facet would report."""
        return round(MIN_AREA_M2 / self.voxel_m**2)


def _open3d() -> Any:
    """The wheel wants a system's libusb, which few machines without a screen have."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


open3d = _open3d()


def open3d_cloud(centroids: Float, normals: Float | None = None) -> Any:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(centroids))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    return cloud


def open3d_normals(cloud: Any, radius_m: float, max_neighbours: int) -> None:
    """Its own k-d tree is part of the work, as finding neighbours is of Facet's."""
    search = open3d.geometry.KDTreeSearchParamHybrid(radius_m, max_neighbours)
    cloud.estimate_normals(search)


def open3d_tensor_cloud(centroids: Float) -> Any:
    """The newer of its two kinds of cloud, in float32."""
    return open3d.t.geometry.PointCloud(open3d.core.Tensor(centroids.astype(np.float32)))


def open3d_tensor_normals(cloud: Any, radius_m: float, max_neighbours: int) -> None:
    cloud.estimate_normals(max_nn=max_neighbours, radius=radius_m)


def open3d_patches(
    cloud: Any, min_points: int, variance_deg: float = 60.0, coplanarity_deg: float = 75.0
) -> list[Any]:
    """Oriented boxes of planar patches (Araujo & Oliveira 2020); angles: its own defaults."""
    return list(
        cloud.detect_planar_patches(
            normal_variance_threshold_deg=variance_deg,
            coplanarity_deg=coplanarity_deg,
            outlier_ratio=0.75,
            min_plane_edge_length=MIN_EDGE_M,
            min_num_points=min_points,
            search_param=open3d.geometry.KDTreeSearchParamKNN(OPEN3D_NEIGHBOURS),
        )
    )


def open3d_labels(boxes: list[Any], cloud: Cloud) -> NDArray[np.int32]:
    """(V,) the patch of each voxel: the nearest plane of those whose box holds it in the plane,
    within a voxel of it and 25 degrees of its normal. It hands out boxes, not their points."""
    labels = np.full(len(cloud.centroids), -1, np.int32)
    nearest = np.full(len(cloud.centroids), cloud.voxel_m)
    for number, box in enumerate(boxes):
        axes, half = np.asarray(box.R), np.asarray(box.extent) / 2.0
        local = (cloud.centroids - np.asarray(box.center)) @ axes
        thin = int(np.argmin(half))
        off = np.abs(local[:, thin])
        half[thin] = np.inf
        agrees = np.abs(cloud.normals @ axes[:, thin]) >= np.cos(np.radians(MOST_NORMALS_DEG))
        held = (np.abs(local) <= half + 0.5 * cloud.voxel_m).all(axis=1)
        own = held & agrees & (off < nearest)
        labels[own], nearest[own] = number, off[own]
    return labels


def cgal_points(cloud: Cloud) -> tuple[Any, Any]:
    """A Point_set_3 with normals, and the map of a shape a point: read from a file, as its Python
    has no arrays."""
    from CGAL.CGAL_Point_set_3 import Point_set_3

    header = "\n".join(
        [
            *("ply", "format binary_little_endian 1.0", f"element vertex {len(cloud.centroids)}"),
            *(f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
            *("end_header", ""),
        ]
    )
    rows = np.concatenate([cloud.centroids, cloud.normals], axis=1).astype("<f8")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.ply"
        path.write_bytes(header.encode() + rows.tobytes())
        points = Point_set_3()
        points.read(str(path))
    if points.size() != len(rows):
        raise RuntimeError(f"CGAL read {points.size()} of {len(rows)} points")
    return points, points.add_int_map("shape")


def cgal_growing(
    points: Any, shapes: Any, cloud: Cloud, distance: float = 1.0, neighbours: int = 12
) -> int:
    """Region growing on nearest neighbours (Lafarge & Mallet 2012), `distance` voxels from the
    plane at most; 12: the default of CGAL's own examples. Returns the number of shapes."""
    from CGAL.CGAL_Shape_detection import region_growing

    return int(
        region_growing(
            points, shapes, cloud.min_points, distance * cloud.voxel_m, -1.0,
            np.cos(np.radians(MOST_NORMALS_DEG)), neighbours,
        )
    )  # fmt: skip


def cgal_ransac(points: Any, shapes: Any, cloud: Cloud, distance: float = 0.6) -> int:
    """Efficient RANSAC (Schnabel et al. 2007), planes only, `distance` voxels from the plane at
    most: two standard deviations of our drives. Returns the number of shapes."""
    from CGAL.CGAL_Shape_detection import efficient_RANSAC

    found = efficient_RANSAC(
        points, shapes, cloud.min_points, distance * cloud.voxel_m, REACH * cloud.voxel_m,
        np.cos(np.radians(MOST_NORMALS_DEG)), 0.01, True, False, False, False, False,
    )  # fmt: skip
    return len(found)


def cgal_labels(points: Any, centroids: Float) -> NDArray[np.int32]:
    """(V,) the shape of each point, -1: none. Written and read again, for the same reason."""
    row = np.dtype([("xyz", "<f8", 3), ("normal", "<f8", 3), ("shape", "<i4")])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shapes.ply"
        points.write(str(path))
        _, _, body = path.read_bytes().partition(b"end_header\n")
    found, labels = np.frombuffer(body, row), np.empty(len(centroids), np.int32)
    order, theirs = np.lexsort(centroids.T), np.lexsort(found["xyz"].T)  # RANSAC sorts them
    if not np.array_equal(found["xyz"][theirs], centroids[order]):
        raise RuntimeError("CGAL changed the points")
    labels[order] = found["shape"][theirs]
    return labels
