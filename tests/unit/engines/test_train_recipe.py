"""Training on a small run: truth of the views, what the losses ask for, going on after a stop, a model that flies."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not there (extra `train`): nothing of the training is tested")

from terrafix_engines.features import open_describer  # noqa: E402
from terrafix_engines.manifest import read  # noqa: E402
from terrafix_engines.train.errors import TrainingError  # noqa: E402
from terrafix_engines.train.export import Words, export  # noqa: E402
from terrafix_engines.train.loop import Recipe, Training, in_other_weather, rate_at  # noqa: E402
from terrafix_engines.train.losses import PLACES, WEIGHTS, corners, places  # noqa: E402
from terrafix_engines.train.network import Describing, levelled  # noqa: E402
from terrafix_engines.train.views import MEASURED, REACH_CELLS, TRAINED, Ranges, Sheet, draw  # noqa: E402

LEAN_FREE = Ranges(lean_px=0.0, occluders=0)


def sheet(name: str, seed: int, dates: int = 2) -> Sheet:
    """Smooth ground with structure at all scales; dates differ in gain."""
    rng = np.random.default_rng(seed)
    ground = sum(
        cv2.resize(rng.random((side, side, 3)), (720, 720), interpolation=cv2.INTER_CUBIC) for side in (12, 45, 120)
    )
    first = np.clip(ground * 85, 1, 255).astype(np.uint8).transpose(2, 0, 1)
    return Sheet(name, torch.from_numpy(np.stack([first, (0.8 * first).astype(np.uint8)][:dates])))


def test_the_truth_is_where_both_views_show_the_same_ground() -> None:
    views = draw([sheet("a", 1, dates=1)], 3, np.random.default_rng(3), LEAN_FREE)
    middles = 8 * np.arange(32) + 3.5
    for camera, ground, true_px, seen in zip(views.camera, views.ground, views.true_px, views.seen, strict=True):
        x, y = np.meshgrid(middles.astype(np.float32), middles.astype(np.float32))
        here = cv2.remap(camera.permute(1, 2, 0).numpy(), x, y, cv2.INTER_LINEAR)
        at = true_px.numpy().astype(np.float32)
        there = cv2.remap(ground.permute(1, 2, 0).numpy(), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        assert seen.float().mean() > 0.5
        assert np.abs(here - there)[seen.numpy()].mean() < 0.02  # twice interpolated; by chance it is 0.15


def test_what_leans_and_what_is_hidden_is_in_the_truth() -> None:
    rng = np.random.default_rng(1)
    views = draw([sheet("a", 1)], 8, rng, TRAINED)
    own = slice(REACH_CELLS, REACH_CELLS + 32)
    lean_px = (views.true_px - views.at_px[:, own, own]).norm(dim=-1)
    assert 0.5 < float(lean_px.max()) <= TRAINED.lean_px
    assert not bool(views.seen.all())


def test_weather_keeps_the_ground_where_it_is_and_follows_the_seed() -> None:
    views = draw([sheet("a", 1), sheet("b", 2)], 4, np.random.default_rng(1), MEASURED)
    one, same, other = (in_other_weather(views, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one.camera, same.camera) and not torch.equal(one.camera, other.camera)
    assert float(one.camera.min()) >= 0.0 and float(one.camera.max()) <= 1.0
    assert one.at_px is views.at_px
    gradients = [levelled(v).mean(1).flatten(1) for v in (views.camera, one.camera)]
    correlation = torch.nn.functional.cosine_similarity(*gradients, dim=1).abs()
    assert float(correlation.median()) > 0.5  # the same pixels; a picture that moved would have none


def test_the_right_place_is_the_middle_of_the_correlation() -> None:
    views = draw([sheet("a", 1, dates=1)], 2, np.random.default_rng(5), LEAN_FREE)
    pool = torch.nn.AvgPool2d(8)
    surface = places(pool(levelled(views.camera)), pool(levelled(views.ground)), views)
    best = surface.flatten(1).argmax(1)
    assert surface.shape == (2, PLACES, PLACES)
    assert best.tolist() == [PLACES**2 // 2] * 2


def test_a_corner_is_found_in_its_cell_and_level_ground_has_none() -> None:
    view = torch.full((1, 3, 256, 256), 0.5)
    view[:, :, 83:, 45:] = 0.9  # a corner at row 83, column 45
    found = corners(view)
    which = int(found[0, 83 // 8, 45 // 8])
    assert abs(which // 8 - 83 % 8) <= 1 and abs(which % 8 - 45 % 8) <= 1
    assert int(found[0, 25, 25]) == 64


def test_the_rate_rises_and_ends_at_zero() -> None:
    rates = [rate_at(step, 1000) for step in range(1001)]
    assert rates[0] < 0.05 and max(rates) > 0.9 and rates[-1] == 0.0
    assert np.argmax(rates) in range(40, 60)


STEPS = 4


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of a training that was not stopped."""
    return taught(tmp_path_factory.mktemp("train") / "whole.pt", STEPS)


def training(checkpoint: Path) -> Training:
    torch.set_num_threads(1)
    recipe = Recipe(steps=STEPS, batch=2, width=16, seed=7, trained_on=("a",), held_out=("b",))
    return Training(recipe, [sheet("a", 1)], [sheet("b", 2)], checkpoint, "cpu")


def taught(checkpoint: Path, steps: int) -> Path:
    begun = training(checkpoint)
    for _ in range(steps):
        begun._teach()
    begun.keep()
    return checkpoint


def test_the_loss_on_the_same_views_falls(whole: Path, tmp_path: Path) -> None:
    views = draw([sheet("a", 1)], 2, np.random.default_rng(9), TRAINED)

    def loss(of: Training) -> float:
        with torch.no_grad():
            losses = of._teacher.losses(of.network, views, torch.Generator().manual_seed(1))
        assert set(losses) == set(WEIGHTS)
        return sum(WEIGHTS[name] * float(value) for name, value in losses.items())

    assert loss(training(whole)) < loss(training(tmp_path / "none.pt")) - 0.1


def test_what_was_stopped_goes_on_to_the_same_weights(whole: Path, tmp_path: Path) -> None:
    taught(tmp_path / "stopped.pt", 2)
    stopped = taught(tmp_path / "stopped.pt", STEPS - 2)
    once, twice = (training(path).network.state_dict() for path in (whole, stopped))
    assert all(torch.equal(once[name], twice[name]) for name in once)


def test_another_recipe_does_not_go_on_where_this_one_stopped(whole: Path) -> None:
    other = replace(training(whole).recipe, seed=8)
    with pytest.raises(TrainingError, match="another recipe"):
        Training(other, [sheet("a", 1)], [sheet("b", 2)], whole, "cpu")


def test_the_onnx_file_answers_like_the_network_and_goes_where_xfeat_goes(whole: Path, tmp_path: Path) -> None:
    network = training(whole).network.eval()
    path = export(network, tmp_path, Words("tiny-own", 'mine, "all" of it', "b"))
    manifest = read(path.with_suffix(".toml"))
    assert manifest.role == "dense" and manifest.licence == 'mine, "all" of it'
    describer = open_describer("tiny-own", str(tmp_path))
    picture = np.random.default_rng(1).integers(0, 255, (160, 224, 3), dtype=np.uint8)
    found = describer.describe(picture)
    assert found.shape == (64, 20, 28)
    tensor = torch.from_numpy(picture[:, :, ::-1].transpose(2, 0, 1).copy())[None].float() / 255
    with torch.no_grad():
        expected = network(tensor)[0][0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert describer.describe(picture[:150, :200]).shape == (64, 18, 25)  # filled up, and cut again


def test_a_tile_of_the_map_says_what_the_whole_map_says() -> None:
    """Descriptors in the middle of a picture do not depend on how large it is: brightness is taken away locally."""
    torch.manual_seed(1)
    network = Describing(16).eval()
    whole = draw([sheet("a", 1)], 1, np.random.default_rng(1), MEASURED).ground
    part = whole[:, :, 64:384, 64:384]
    with torch.no_grad():
        alike = torch.nn.functional.cosine_similarity(
            network(whole)[0][:, :, 18:38, 18:38], network(part)[0][:, :, 10:30, 10:30], dim=1
        )
    assert float(alike.min()) > 0.99
