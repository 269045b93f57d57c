import copy

import numpy as np
import pytest
import torch

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.refine import prune, refine
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.training.optimizers import LateDecaySchedulerConfig, RowAdam, RowOptimizer, RowRMSprop, touched_rows

ROWS, CHANNELS = 50, 6
KINDS = {"adam": RowAdam, "rmsprop": RowRMSprop}


def gradient(seed: int, share: float = 1.0, rows: int = ROWS, dtype=torch.float32) -> torch.Tensor:
    """A row-sparse gradient that touches about `share` of the rows."""
    generator = torch.Generator().manual_seed(seed)
    chosen = (torch.rand(rows, generator=generator) < share).nonzero()[:, 0]
    values = torch.randn(len(chosen), CHANNELS, generator=generator, dtype=torch.float64).to(dtype)
    return torch.sparse_coo_tensor(chosen[None], values, (rows, CHANNELS), is_coalesced=True, check_invariants=True)


def parameter(seed: int = 0, dtype=torch.float32) -> torch.nn.Parameter:
    values = torch.randn(ROWS, CHANNELS, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.Parameter(values.to(dtype))


def step(optimizer: torch.optim.Optimizer, of: torch.nn.Parameter, grad: torch.Tensor) -> None:
    of.grad = grad
    optimizer.step()


@pytest.mark.parametrize("layout", ["sparse", "dense"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("ours", "theirs", "options"),
    [
        (RowAdam, torch.optim.Adam, {"lr": 0.1, "betas": (0.9, 0.999), "eps": 1e-15}),
        (RowAdam, torch.optim.Adam, {"lr": 0.03, "betas": (0.5, 0.8), "eps": 1e-3}),
        (RowAdam, torch.optim.Adam, {"lr": 0.03, "betas": (0.0, 0.9), "eps": 1e-8}),
        (RowRMSprop, torch.optim.RMSprop, {"lr": 0.1, "alpha": 0.95, "eps": 1e-8}),
        (RowRMSprop, torch.optim.RMSprop, {"lr": 0.01, "alpha": 0.5, "eps": 1e-2}),
    ],
)
def test_torch_s_own_where_all_rows_are_touched(ours, theirs, options, dtype, layout):
    here, there = parameter(dtype=dtype), parameter(dtype=dtype)
    a, b = ours([here], **options), theirs([there], **options)
    for n in range(25):
        grad = gradient(n, dtype=dtype)
        step(a, here, grad if layout == "sparse" else grad.to_dense())
        step(b, there, grad.to_dense())
    rtol = 1e-11 if dtype == torch.float64 else 2e-5
    torch.testing.assert_close(here.data, there.data, rtol=rtol, atol=rtol)


def adam_by_hand(grads: list[np.ndarray], lr: float, beta1: float, beta2: float, eps: float) -> np.ndarray:
    """Change of a value by Adam (Kingma and Ba 2015, algorithm 1)."""
    m = v = change = 0.0
    for t, g in enumerate(grads, 1):
        m, v = beta1 * m + (1 - beta1) * g, beta2 * v + (1 - beta2) * g * g
        change = change - lr * m / (1 - beta1**t) / (np.sqrt(v / (1 - beta2**t)) + eps)
    return np.asarray(change)


def test_each_row_counts_its_own_updates():
    """A row that was touched in steps 3, 7 and 8 is where Adam would be after three steps of its own."""
    value = parameter(dtype=torch.float64)
    start, history = value.detach().clone(), [[] for _ in range(ROWS)]
    optimizer = RowAdam([value], lr=0.1, betas=(0.9, 0.99), eps=1e-6)
    for n in range(12):
        grad = gradient(n, 0.3, dtype=torch.float64)
        for row, g in zip(*(part.numpy() for part in touched_rows(grad))):
            history[row].append(g)
        step(optimizer, value, grad)
    expected = np.stack([adam_by_hand(grads, 0.1, 0.9, 0.99, 1e-6) * np.ones(CHANNELS) for grads in history])
    np.testing.assert_allclose((value.detach() - start).numpy(), expected, rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(optimizer.state[value]["updates"].numpy(), [len(grads) for grads in history])
    assert len({len(grads) for grads in history}) > 3


def plain_twin(
    optimizer: RowOptimizer, value: torch.Tensor, grad: torch.Tensor, state: dict[str, torch.Tensor]
) -> None:
    """One step through the branch that other devices take."""

    class Disguised:
        def __init__(self, tensor: torch.Tensor):
            self.tensor, self.device = tensor, torch.device("meta")

        def __len__(self) -> int:
            return len(self.tensor)

        def __getitem__(self, rows):
            return self.tensor[rows]

        def __setitem__(self, rows, values) -> None:
            self.tensor[rows] = values

    rows, values = touched_rows(grad)
    optimizer.update_rows(Disguised(value), rows, values, state, optimizer.param_groups[0])  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fractional", [False, True])
def test_compiled_updates_are_those_of_their_plain_twin(kind, fractional):
    """Also where interpolation left rows with a number of updates that is no whole number."""
    value = parameter(dtype=torch.float64)
    twin = value.detach().clone()
    optimizer = KINDS[kind]([value], lr=0.1)
    state = optimizer.new_state(twin)
    optimizer.state[value].update(optimizer.new_state(value))
    if fractional and kind == "adam":
        counts = torch.rand(ROWS, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 9
        counts[:3] = torch.tensor([7.0 - 1e-7, 7.0, 7.0 + 1e-7])
        for held in (state, optimizer.state[value]):
            held["updates"].copy_(counts)
            held["exp_avg"].fill_(0.2)
            held["exp_avg_sq"].fill_(0.3)
    for n in range(6):
        grad = gradient(n, 0.5, dtype=torch.float64)
        step(optimizer, value, grad)
        plain_twin(optimizer, twin, grad, state)
    torch.testing.assert_close(value.data, twin, rtol=1e-12, atol=1e-14)
    for name, values in state.items():
        torch.testing.assert_close(optimizer.state[value][name], values, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("late", [1, 4095, 4096, 4097, 9999])
@pytest.mark.parametrize("same", [False, True])
def test_rows_out_of_order_are_found_wherever_they_are(late, same):
    """A number smaller than the one before, or the same, in a long list; values are put in order and added up."""
    listed = torch.arange(1, 10_001)
    listed[late] = late if same else 0
    values = torch.arange(10_000.0)[:, None]
    rows, sums = touched_rows(torch.sparse_coo_tensor(listed[None], values, (10_002, 1)))
    assert len(rows) == 10_000 - same and bool((rows[1:] > rows[:-1]).all())
    assert torch.equal(
        torch.zeros(10_002, 1).index_add(0, rows, sums), torch.zeros(10_002, 1).index_add(0, listed, values)
    )


def trained_grid(kind: str) -> tuple[VoxelGrid, dict[str, RowOptimizer]]:
    """A sparse grid after a few steps that touched some rows."""
    torch.manual_seed(0)
    grid = VoxelGrid(Lattice((0.0, 0.0, 0.0), 1.0, (6, 5, 4)), sh_degree=1, temperature_degree=1)
    prune(grid, np.random.default_rng(0).random(len(grid.voxels)) < 0.6)
    optimizers = {name: KINDS[kind]([p], lr=0.1) for name, p in grid.row_parameters().items()}
    for _ in range(4):
        for name, p in grid.row_parameters().items():
            rows = (torch.rand(len(p)) < 0.5).nonzero()[:, 0]
            step(optimizers[name], p, torch.sparse_coo_tensor(rows[None], torch.randn(len(rows), p.shape[1]), p.shape))
    return grid, optimizers


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", ["split", "prune"])
def test_state_follows_split_and_pruned_rows(kind, change):
    """As the values do, of which tests/field/test_refine.py tells what becomes."""
    grid, optimizers = trained_grid(kind)
    old = grid.row_parameters()
    states = {name: copy.deepcopy(dict(optimizers[name].state[p])) for name, p in old.items()}
    moved = refine(grid, 2) if change == "split" else prune(grid, np.arange(len(grid.voxels)) % 3 == 0)
    for name, new in grid.row_parameters().items():
        optimizer = optimizers[name]
        optimizer.follow(old[name], new, moved)
        assert [p for group in optimizer.param_groups for p in group["params"]] == [new]
        assert list(optimizer.state) == [new] and new is not old[name]
        for key, values in optimizer.state[new].items():
            before = states[name][key]
            assert torch.equal(values, moved(before.view(len(before), -1)).view(len(new), *before.shape[1:]))
        before = new.detach().clone()
        rows = torch.tensor([0, len(new) - 1])
        step(optimizer, new, torch.sparse_coo_tensor(rows[None], torch.ones(2, new.shape[1]), new.shape))
        assert (new != before).any(-1).nonzero()[:, 0].tolist() == rows.tolist()


def test_a_rate_that_falls_late_is_high_for_most_of_a_run_and_stays_low_after_it():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.5)
    schedule = LateDecaySchedulerConfig(lr_final=0.01, max_steps=100).setup().get_scheduler(optimizer, 0.5)
    rates = []
    for _ in range(150):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[0] == 0.5 and rates[50] == pytest.approx(0.255) and rates[90] < 0.03
    assert rates == sorted(rates, reverse=True)
    assert rates[100:] == pytest.approx([0.01] * 50)
