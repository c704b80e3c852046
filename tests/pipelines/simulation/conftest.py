import numpy as np
import pytest

from spheremark.pipelines.model import ControlMarks
from spheremark.pipelines.simulation import Field, SimulationConfig, Stop, scenario, simulate_stop
from spheremark.pipelines.simulation.field import marker_surfaces
from spheremark.pipelines.simulation.scene import Mesh, Scene, terrain_mesh
from spheremark.pipelines.simulation.terrain import Terrain

MARKS = np.array([[4.0, 1.0, 1.1], [-1.0, 5.0, 0.9], [-3.0, -2.5, 1.3]])


@pytest.fixture(scope="session")
def plain() -> Field:
    """Level ground at height zero, three markers and two stops."""
    lines = np.array([-30.0, 0.0, 30.0])
    terrain = Terrain(xs=lines, ys=lines.copy(), heights=np.zeros((3, 3)))
    posts, spheres, poles = marker_surfaces(MARKS.copy(), terrain.height_at(MARKS))
    ground = terrain_mesh(np.random.default_rng(0), terrain)
    stops = tuple(
        Stop(name=name, p_site=np.array([x, 0.2, 1.0]), heading=0.3)
        for name, x in (("first", 0.0), ("second", 0.5))
    )
    return Field(
        scenario="plain",
        seed=5,
        terrain=terrain,
        scene=Scene(mesh=Mesh.merged([ground, posts]), spheres=spheres, poles=poles),
        marks=ControlMarks(
            names=("A", "B", "C"), p_site=MARKS.copy(), cov_p_site=np.zeros((3, 3, 3))
        ),
        marker_radius=0.100,
        stops=stops,
    )


@pytest.fixture(scope="session")
def paper_field() -> Field:
    return scenario("paper-field", 3)


@pytest.fixture(scope="session")
def brief():
    """A noisy, misaligned scan of the plain in one second."""
    return SimulationConfig(turn=1.0)


@pytest.fixture(scope="session")
def noisy(plain, brief):
    return simulate_stop(plain, "first", brief)


def points_site(stop, rig):
    """Stitch a simulated log by the definition of the frames, with a rig and the true pose."""
    log = stop.log
    times = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) * 1e-9
    samples = (log.stamps_gimbal_ns - log.stamps_lidar_ns[0]) * 1e-9 + rig.gimbal_clock_offset
    cosine, sine = rig.encoder_eccentricity
    recorded = log.gimbal_angles
    angles = np.interp(
        times, samples, recorded + cosine * np.cos(recorded) + sine * np.sin(recorded)
    )
    p_lidar = log.p_lidar.astype(float)
    origins = np.zeros_like(p_lidar)
    origins[:, 2] = rig.laser_heights[log.rings]
    ranges = np.linalg.norm(p_lidar - origins, axis=1)
    p_lidar -= (p_lidar - origins) * (rig.laser_range_biases[log.rings] / ranges)[:, None]
    p_head = p_lidar @ rig.T_head_lidar[:3, :3].T + rig.T_head_lidar[:3, 3]
    c, s = np.cos(angles), np.sin(angles)
    p_base = np.column_stack(
        [c * p_head[:, 0] - s * p_head[:, 1], s * p_head[:, 0] + c * p_head[:, 1], p_head[:, 2]]
    )
    return p_base @ stop.truth.T_site_base[:3, :3].T + stop.truth.T_site_base[:3, 3]


@pytest.fixture(scope="session")
def stitched():
    return points_site
