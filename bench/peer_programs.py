"""What other libraries make of the same scans and start poses: pairs aligned one by one, then a graph of poses.

Run by `peers.py`, in an environment that has numpy, plyfile, open3d and small_gicp:
python peer_programs.py open3d|small_gicp VOXEL CLOUDS START.npy OUT.npy
VOXEL, in mm, is the grid to which clouds are thinned for the alignment; 0: not at all.
"""

import sys
from itertools import combinations
from pathlib import Path

import numpy as np
from plyfile import PlyData

# Settings of both, the best of some that were tried: distances between partners, coarse to fine (mm), and how much of a
# view must meet another.
DISTANCES, OVERLAP = (2.0, 0.8, 0.4), 0.3
# Of the alignments: neighbours of a normal or covariance, robust scale of point-to-plane (mm).
NEIGHBOURS, ROBUST = 20, 0.2


def main() -> None:
    which, voxel, folder, start, out = sys.argv[1:]
    files = sorted(Path(folder).iterdir())
    clouds = [np.column_stack([PlyData.read(str(f))["vertex"][a] for a in "xyz"]).astype(float) for f in files]
    edges = {"open3d": open3d_edges, "small_gicp": small_gicp_edges}[which]
    poses = np.load(start)
    poses = optimised(poses, edges(clouds, poses, float(voxel)))
    np.save(out, poses)
    merged = np.concatenate([c @ T[:3, :3].T + T[:3, 3] for c, T in zip(clouds, poses, strict=True)])
    merged.astype("<f4").tofile(Path(out).with_suffix(".xyz"))


def of_one_side(clouds, poses):
    """Pairs that look at the part from within 60° of each other: on a thin part the other side lies within reach."""
    looks = [T[:3, :3] @ c.mean(axis=0) / np.linalg.norm(c.mean(axis=0)) for c, T in zip(clouds, poses, strict=True)]
    return [(i, j) for i, j in combinations(range(len(clouds)), 2) if looks[i] @ looks[j] > 0.5]


def open3d_edges(clouds, poses, voxel=0.0, distances=DISTANCES):
    """(i, j, T_i_j, information) of all pairs that meet: robust point-to-plane ICP."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    shown = []
    for points in clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(voxel) if voxel else cloud
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
        shown.append(cloud)
    plane = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=ROBUST))
    wide = registration.TransformationEstimationPointToPlane()
    for i, j in of_one_side(clouds, poses):
        T = np.linalg.inv(poses[i]) @ poses[j]
        if registration.evaluate_registration(shown[j], shown[i], DISTANCES[0], T).fitness < OVERLAP:
            continue
        for distance in distances:
            method = plane if distance == distances[-1] else wide
            T = registration.registration_icp(shown[j], shown[i], distance, T, method).transformation
        information = registration.get_information_matrix_from_point_clouds(shown[j], shown[i], distances[-1], T)
        yield i, j, T, information


def small_gicp_edges(clouds, poses, voxel=0.0, distances=DISTANCES):
    """The same by generalised ICP."""
    import small_gicp

    size = voxel or 1e-3
    made = [small_gicp.preprocess_points(p, downsampling_resolution=size, num_neighbors=NEIGHBOURS) for p in clouds]
    for i, j in of_one_side(clouds, poses):
        T = np.linalg.inv(poses[i]) @ poses[j]
        (target, tree), (source, _) = made[i], made[j]
        moved = clouds[j] @ T[:3, :3].T + T[:3, 3]
        _, squared = tree.batch_nearest_neighbor_search(moved, num_threads=2)
        if np.mean(np.asarray(squared) < DISTANCES[0] ** 2) < OVERLAP:
            continue
        for distance in distances:
            found = small_gicp.align(target, source, tree, T, max_correspondence_distance=distance, num_threads=2)
            T = found.T_target_source
        yield i, j, T, found.H


def optimised(poses, edges):
    """T_reference_scanner (V, 4, 4) by Open3D's graph of poses, every pair that meets an edge."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    graph.nodes.extend([registration.PoseGraphNode(T) for T in poses])
    for i, j, T, information in edges:
        # An edge of Open3D leads from its source to its target.
        graph.edges.append(registration.PoseGraphEdge(j, i, T, information, uncertain=False))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(
            max_correspondence_distance=DISTANCES[-1], edge_prune_threshold=0.25, reference_node=0
        ),
    )
    return np.array([node.pose for node in graph.nodes])


if __name__ == "__main__":
    main()
