"""A small training run: true correspondences of the views, losses, resuming, and the exported model."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not there (extra `train`): nothing of the training is tested")

from terrafix_engines.features import open_describer  # noqa: E402
from terrafix_engines.manifest import read  # noqa: E402
from terrafix_lab.train.errors import TrainingError  # noqa: E402
from terrafix_lab.train.export import ManifestText, export  # noqa: E402
from terrafix_lab.train.loop import Recipe, Training, augment_views, learning_rate_factor  # noqa: E402
from terrafix_lab.train.losses import PLACES, WEIGHTS, corners, places  # noqa: E402
from terrafix_lab.train.network import FeatureNetwork, normalise_contrast  # noqa: E402
from terrafix_lab.train.views import (  # noqa: E402
    EVALUATION_RANGES,
    REACH_CELLS,
    TRAINING_RANGES,
    ImageStack,
    Ranges,
    sample_views,
)

NO_RELIEF = Ranges(relief_px=0.0, occluders=0)


def sheet(name: str, seed: int, dates: int = 2) -> ImageStack:
    """Smooth ground with structure at all scales; dates differ in gain."""
    rng = np.random.default_rng(seed)
    ground = sum(
        cv2.resize(rng.random((side, side, 3)), (720, 720), interpolation=cv2.INTER_CUBIC) for side in (12, 45, 120)
    )
    first = np.clip(ground * 85, 1, 255).astype(np.uint8).transpose(2, 0, 1)
    return ImageStack(name, torch.from_numpy(np.stack([first, (0.8 * first).astype(np.uint8)][:dates])))


def test_the_true_correspondences_show_the_same_ground_in_both_views() -> None:
    views = sample_views([sheet("a", 1, dates=1)], 3, np.random.default_rng(3), NO_RELIEF)
    middles = 8 * np.arange(32) + 3.5
    for camera, ground, true_px, seen in zip(views.camera, views.ground, views.true_px, views.seen, strict=True):
        x, y = np.meshgrid(middles.astype(np.float32), middles.astype(np.float32))
        here = cv2.remap(camera.permute(1, 2, 0).numpy(), x, y, cv2.INTER_LINEAR)
        at = true_px.numpy().astype(np.float32)
        there = cv2.remap(ground.permute(1, 2, 0).numpy(), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        assert seen.float().mean() > 0.5
        assert np.abs(here - there)[seen.numpy()].mean() < 0.02  # interpolated twice; 0.15 for unrelated pixels


def test_relief_displacement_and_occlusion_are_part_of_the_truth() -> None:
    rng = np.random.default_rng(1)
    views = sample_views([sheet("a", 1)], 8, rng, TRAINING_RANGES)
    own = slice(REACH_CELLS, REACH_CELLS + 32)
    relief_px = (views.true_px - views.at_px[:, own, own]).norm(dim=-1)
    assert 0.5 < float(relief_px.max()) <= TRAINING_RANGES.relief_px
    assert not bool(views.seen.all())


def test_augmentation_keeps_the_geometry_and_is_deterministic_per_seed() -> None:
    views = sample_views([sheet("a", 1), sheet("b", 2)], 4, np.random.default_rng(1), EVALUATION_RANGES)
    one, same, other = (augment_views(views, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one.camera, same.camera) and not torch.equal(one.camera, other.camera)
    assert float(one.camera.min()) >= 0.0 and float(one.camera.max()) <= 1.0
    assert one.at_px is views.at_px
    gradients = [normalise_contrast(v).mean(1).flatten(1) for v in (views.camera, one.camera)]
    correlation = torch.nn.functional.cosine_similarity(*gradients, dim=1).abs()
    assert float(correlation.median()) > 0.5  # the same pixels; a displaced image has no correlation


def test_the_true_offset_is_the_centre_of_the_correlation_surface() -> None:
    views = sample_views([sheet("a", 1, dates=1)], 2, np.random.default_rng(5), NO_RELIEF)
    pool = torch.nn.AvgPool2d(8)
    surface = places(pool(normalise_contrast(views.camera)), pool(normalise_contrast(views.ground)), views)
    best = surface.flatten(1).argmax(1)
    assert surface.shape == (2, PLACES, PLACES)
    assert best.tolist() == [PLACES**2 // 2] * 2


def test_a_corner_is_found_in_its_cell_and_uniform_ground_has_none() -> None:
    view = torch.full((1, 3, 256, 256), 0.5)
    view[:, :, 83:, 45:] = 0.9  # a corner at row 83, column 45
    found = corners(view)
    which = int(found[0, 83 // 8, 45 // 8])
    assert abs(which // 8 - 83 % 8) <= 1 and abs(which % 8 - 45 % 8) <= 1
    assert int(found[0, 25, 25]) == 64


def test_the_learning_rate_rises_and_decays_to_zero() -> None:
    rates = [learning_rate_factor(step, 1000) for step in range(1001)]
    assert rates[0] < 0.05 and max(rates) > 0.9 and rates[-1] == 0.0
    assert np.argmax(rates) in range(40, 60)


STEPS = 4


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of an uninterrupted training."""
    return taught(tmp_path_factory.mktemp("train") / "whole.pt", STEPS)


def training(checkpoint: Path) -> Training:
    torch.set_num_threads(1)
    recipe = Recipe(steps=STEPS, batch=2, width=16, seed=7, trained_on=("a",), held_out=("b",))
    return Training(recipe, [sheet("a", 1)], [sheet("b", 2)], checkpoint, "cpu")


def taught(checkpoint: Path, steps: int) -> Path:
    begun = training(checkpoint)
    for _ in range(steps):
        begun._train_step()
    begun.save_checkpoint()
    return checkpoint


def test_training_reduces_the_loss_on_the_same_views(whole: Path, tmp_path: Path) -> None:
    views = sample_views([sheet("a", 1)], 2, np.random.default_rng(9), TRAINING_RANGES)

    def loss(of: Training) -> float:
        with torch.no_grad():
            losses = of._criterion.losses(of.network, views, torch.Generator().manual_seed(1))
        assert set(losses) == set(WEIGHTS)
        return sum(WEIGHTS[name] * float(value) for name, value in losses.items())

    assert loss(training(whole)) < loss(training(tmp_path / "none.pt")) - 0.1


def test_a_resumed_training_gives_the_same_weights(whole: Path, tmp_path: Path) -> None:
    taught(tmp_path / "stopped.pt", 2)
    stopped = taught(tmp_path / "stopped.pt", STEPS - 2)
    once, twice = (training(path).network.state_dict() for path in (whole, stopped))
    assert all(torch.equal(once[name], twice[name]) for name in once)


def test_a_checkpoint_of_other_options_is_rejected(whole: Path) -> None:
    other = replace(training(whole).recipe, seed=8)
    with pytest.raises(TrainingError, match="other options"):
        Training(other, [sheet("a", 1)], [sheet("b", 2)], whole, "cpu")


def test_the_onnx_export_equals_the_network_and_replaces_xfeat(whole: Path, tmp_path: Path) -> None:
    network = training(whole).network.eval()
    path = export(network, tmp_path, ManifestText("tiny-own", 'mine, "all" of it', "b"))
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
    assert describer.describe(picture[:150, :200]).shape == (64, 18, 25)  # padded, and cropped again


def test_descriptors_of_a_map_tile_equal_those_of_the_whole_map() -> None:
    """Descriptors do not depend on the size of the image, because brightness is normalised locally."""
    torch.manual_seed(1)
    network = FeatureNetwork(16).eval()
    whole = sample_views([sheet("a", 1)], 1, np.random.default_rng(1), EVALUATION_RANGES).ground
    part = whole[:, :, 64:384, 64:384]
    with torch.no_grad():
        alike = torch.nn.functional.cosine_similarity(
            network(whole)[0][:, :, 18:38, 18:38], network(part)[0][:, :, 10:30, 10:30], dim=1
        )
    assert float(alike.min()) > 0.99
