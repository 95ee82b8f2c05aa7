"""The z-buffer against ray casting and against formulas."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from mass_engine.camera import Camera
from mass_engine.evaluation.mesh_raster import mesh_mask, rasterize_mesh


def test_a_scene_agrees_with_cast_rays() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    box = trimesh.creation.box((0.08, 0.3, 0.02))
    corners = np.array(sphere.vertices)
    vertices = np.concatenate([corners, np.array(box.vertices) + np.array([0.05, 0.0, -0.09])])
    faces = np.concatenate([sphere.faces, np.array(box.faces) + len(corners)]).astype(np.int64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor(Rotation.from_rotvec([0.17, 0.34, 0.1]).as_matrix())
    pose[:3, 3] = torch.tensor([0.02, -0.01, 0.5], dtype=torch.float64)
    camera = Camera.from_fov(64, 48, 50.0)
    camera = Camera(camera.K, pose, 64, 48)
    found = rasterize_mesh(vertices, faces, camera)
    rows, columns = np.mgrid[0:48, 0:64]
    K, R, t = camera.K.double().numpy(), pose[:3, :3].double().numpy(), pose[:3, 3].double().numpy()
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones((48, 64))], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    origin = -R.T @ t
    corners = vertices[faces]
    # Moeller and Trumbore, every ray with every triangle; the ray's parameter is the camera's z.
    world = rays @ R
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    h = np.cross(world[:, None], e2)
    det = (e1 * h).sum(-1)
    s = origin - corners[:, 0]
    u = (s * h).sum(-1) / det
    q = np.cross(s, e1)
    v = (world[:, None] * q).sum(-1) / det
    z = np.where((u >= 0) & (v >= 0) & (u + v <= 1), (e2 * q).sum(-1) / det, np.inf).min(1).reshape(48, 64)
    hit = np.isfinite(z)
    assert 300 < hit.sum() < 2500
    np.testing.assert_array_equal(found.face >= 0, hit)
    np.testing.assert_allclose(found.depth[hit], z[hit], rtol=1e-9)
    assert (found.depth[~hit] == 0).all()
    # Positions interpolated at the pixels project back onto them.
    points = found.interpolate(faces, vertices)[hit] @ R.T + t
    pixels = points[:, :2] / points[:, 2:] @ K[:2, :2].T + K[:2, 2]
    np.testing.assert_allclose(pixels, np.stack([columns + 0.5, rows + 0.5], -1)[hit], atol=1e-6)
    # Only the faces turned away are left out.
    culled = rasterize_mesh(vertices, faces, camera, cull=True)
    np.testing.assert_array_equal(culled.face, found.face)
    np.testing.assert_array_equal(rasterize_mesh(vertices, faces[:, ::-1], camera, cull=True).face >= 0, hit)


def test_nothing_is_drawn_behind_or_beside_the_camera() -> None:
    camera = Camera.from_fov(16, 16, 60.0)
    triangle = np.array([[-1.0, -1, 1], [1, -1, 1], [0, 1, 1]])
    faces = np.array([[0, 1, 2]])
    assert mesh_mask(triangle, faces, camera).any()
    assert not mesh_mask(triangle * [1, 1, -1], faces, camera).any()
    assert not mesh_mask(triangle + np.array([50.0, 0, 0]), faces, camera).any()
    assert not mesh_mask(triangle[[0, 0, 1]], faces, camera).any()
