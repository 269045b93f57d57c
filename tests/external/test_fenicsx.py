import numpy as np
import pytest

import thermoxels_ns
from tests.support.docs_code import code_in
from tests.support.heat_bodies import assemble, backward_euler, tagged_body
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.mesh.files.formats import write_xdmf
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import facet_areas

pytestmark = pytest.mark.external
TEN_HOURS = TimeSteps(10, 3600.0)  # In which heat goes about as far as a wall is thick

SCRIPT = """
import sys
import numpy as np
import dolfinx, ufl
from dolfinx import fem
from dolfinx.io import XDMFFile
from mpi4py import MPI
from petsc4py import PETSc

folder, (conductivity, capacity, steps, seconds) = sys.argv[1], map(float, sys.argv[2:6])
num_regions, num_patches = map(int, sys.argv[6:])
with XDMFFile(MPI.COMM_WORLD, folder + "/house.xdmf", "r") as file:
    mesh = file.read_mesh(name="mesh")
    regions = file.read_meshtags(mesh, name="mesh")
    mesh.topology.create_connectivity(2, 3)
    patches = file.read_meshtags(mesh, name="facets")

one = fem.Constant(mesh, PETSc.ScalarType(1.0))
dx = ufl.Measure("dx", domain=mesh, subdomain_data=regions)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=patches)
volumes = [fem.assemble_scalar(fem.form(one * dx(number + 1))) for number in range(num_regions)]
areas = [fem.assemble_scalar(fem.form(one * ds(number + 1))) for number in range(num_patches)]

space = fem.FunctionSpace(mesh, ("CG", 1))
points = space.tabulate_dof_coordinates()
u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
before = fem.Function(space)
given = np.load(folder + "/start.npz")
flat = lambda lists: np.ravel(getattr(lists, "array", lists))
node = np.empty(len(points), dtype=int)
node[flat(space.dofmap.list)] = np.asarray(mesh.geometry.input_global_indices)[flat(mesh.geometry.dofmap)]
assert np.abs(given["points_m"][node] - points).max() < 1e-12
before.x.array[:] = given["temperature_c"][node]

form = capacity / seconds * u * v * ufl.dx + conductivity * ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx
matrix = fem.petsc.assemble_matrix(fem.form(form))
matrix.assemble()
right = fem.form(capacity / seconds * before * v * ufl.dx)
solver = PETSc.KSP().create(mesh.comm)
solver.setOperators(matrix)
solver.setType("preonly")
solver.getPC().setType("lu")
after = fem.Function(space)
states = []
for _ in range(int(steps)):
    load = fem.petsc.assemble_vector(right)
    solver.solve(load, after.vector)
    before.x.array[:] = after.x.array
    state = np.empty(len(points))
    state[node] = after.x.array
    states.append(state)
np.savez(folder + "/result.npz", temperature_c=states, volumes_m3=volumes, areas_m2=areas)
"""


@pytest.fixture(scope="module")
def fenicsx(tmp_path_factory, heat_problem, fenicsx_python, run_in):
    """What FEniCSx reads and computes from our file."""
    folder = tmp_path_factory.mktemp("fenicsx")
    write_xdmf(folder / "house.xdmf", heat_problem.mesh)
    np.savez(folder / "start.npz", points_m=heat_problem.mesh.points_m, temperature_c=heat_problem.start_c)
    (folder / "solve.py").write_text(SCRIPT)
    material, mesh = heat_problem.material, heat_problem.mesh
    values = [material.conductivity_w_mk, material.heat_capacity_j_m3k, TEN_HOURS.steps, TEN_HOURS.step_seconds]
    values += [len(mesh.region_names), len(mesh.boundary.patch_names)]
    run_in(folder, [fenicsx_python, "solve.py", str(folder), *map(repr, values)])
    with np.load(folder / "result.npz") as result:
        return dict(result)


def test_regions_and_patches_keep_their_size(fenicsx, solid_mesh):
    volumes = signed_volumes(solid_mesh.points_m, solid_mesh.tets)
    areas = facet_areas(solid_mesh.points_m, solid_mesh.facets)
    region, patch = solid_mesh.region, solid_mesh.boundary.patch
    expected_m3 = np.bincount(region, volumes, minlength=len(solid_mesh.region_names))
    expected_m2 = np.bincount(patch, areas, minlength=len(solid_mesh.boundary.patch_names))
    assert fenicsx["volumes_m3"] == pytest.approx(expected_m3, rel=1e-12)
    assert fenicsx["areas_m2"] == pytest.approx(expected_m2, rel=1e-12)


def test_TEN_HOURS_agree_with_ours(fenicsx, heat_problem):
    """Both: backward Euler, linear tetrahedra, consistent mass."""
    theirs = fenicsx["temperature_c"]
    consistent = assemble(heat_problem.mesh, heat_problem.material, lumped=False)
    ours = backward_euler(consistent, heat_problem.start_c, TEN_HOURS)
    span = np.ptp(heat_problem.start_c)
    assert np.abs(ours[-1] - heat_problem.start_c).max() > 0.1 * span
    assert np.abs(theirs - ours).max() < 1e-9 * span


def test_the_script_of_the_docs_finds_our_heat_loss(tmp_path, fenicsx_python, run_in):
    """Between the two: its convection is integrated with nodes that share, ours node by node."""
    cells = np.ones((12, 12, 12), dtype=bool)
    cells[4:8, 4:8, 4:8] = False
    outside = np.ones((14, 14, 14), dtype=bool)
    outside[5:9, 5:9, 5:9] = False
    mesh = tagged_body(cells, 0.25, outside)
    write_xdmf(tmp_path / "mesh.xdmf", mesh)
    (tmp_path / "loss.py").write_text(code_in("export.md")[0])
    said = run_in(tmp_path, [fenicsx_python, "loss.py"])
    air = [{"air_c": air_c, "coefficient_w_m2k": w_m2k} for air_c, w_m2k in ((20.0, 7.7), (0.0, 25.0))]
    stone = {"conductivity_w_mk": 2.0, "density_kg_m3": 2000.0, "specific_heat_j_kgk": 1000.0}
    scene = {"materials": {"*": stone}, "inside_air": air[0], "outside_air": air[1], "steady": True}
    ours = thermoxels_ns.solve(mesh, scene)
    assert float(said.split("loss [W]")[1].split()[0]) == pytest.approx(ours.wall.heat_w, rel=0.01)
