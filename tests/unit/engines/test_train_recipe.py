"""A small training run: the true place of the views, the loss, stopping, resuming, and the exported model."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not there (extra `train`): nothing of the training is tested")

from terrafix_engines.features import open_describer  # noqa: E402
from terrafix_engines.manifest import read  # noqa: E402
from terrafix_lab.train import loop  # noqa: E402
from terrafix_lab.train.errors import TrainingError  # noqa: E402
from terrafix_lab.train.export import ManifestText, export  # noqa: E402
from terrafix_lab.train.loop import Recipe, Training, augment_views, learning_rate_factor  # noqa: E402
from terrafix_lab.train.losses import TrainingLoss, place_scores  # noqa: E402
from terrafix_lab.train.network import FeatureNetwork, normalise_contrast  # noqa: E402
from terrafix_lab.train.views import (  # noqa: E402
    CAMERA_PX,
    EVALUATION_RANGES,
    OFFSETS,
    STRIDE,
    ImageStack,
    Ranges,
    sample_views,
)

LEVEL = Ranges(turn_deg=0.0, scale=0.0, tilt=0.0, oblique_share=0.0, roofs=0.0, occluders=0)
OBLIQUE = Ranges(turn_deg=0.0, scale=0.0, tilt=0.0, oblique_share=1.0, roofs=0.0, occluders=0)


def sheet(name: str, seed: int, dates: int = 2) -> ImageStack:
    """Smooth ground with structure at all scales; dates differ in gain."""
    rng = np.random.default_rng(seed)
    ground = sum(
        cv2.resize(rng.random((side, side, 3)), (720, 720), interpolation=cv2.INTER_CUBIC) for side in (12, 45, 120)
    )
    first = np.clip(ground * 85, 1, 255).astype(np.uint8).transpose(2, 0, 1)
    return ImageStack(name, torch.from_numpy(np.stack([first, (0.8 * first).astype(np.uint8)][:dates])))


@pytest.mark.parametrize("ranges, least", [(LEVEL, 0.97), (OBLIQUE, 0.8)])
def test_the_camera_view_shows_the_map_at_its_true_place(ranges: Ranges, least: float) -> None:
    """From the side, too: rectified on level ground, it is the same ground, less sharp."""
    views = sample_views([sheet("a", 1, dates=1)], 4, np.random.default_rng(3), ranges)
    for camera, ground, place in zip(views.camera, views.ground, views.place, strict=True):
        row, column = (float(STRIDE * value) for value in place)
        x, y = np.meshgrid(np.arange(CAMERA_PX, dtype=np.float32), np.arange(CAMERA_PX, dtype=np.float32))
        there = cv2.remap(ground.permute(1, 2, 0).numpy(), x + column, y + row, cv2.INTER_LINEAR)
        inner = slice(20, CAMERA_PX - 20)
        here = camera.permute(1, 2, 0).numpy()
        assert np.corrcoef(here[inner, inner].ravel(), there[inner, inner].ravel())[0, 1] > least


def test_roofs_and_relief_move_what_is_seen_from_the_side() -> None:
    flat, high = (
        sample_views([sheet("a", 1, dates=1)], 2, np.random.default_rng(3), replace(OBLIQUE, roofs=roofs)).camera
        for roofs in (0.0, 0.2)
    )
    stack = sheet("a", 1, dates=1)
    slope = torch.linspace(-40.0, 40.0, 720).expand(720, 720).contiguous()
    hilly = sample_views([replace(stack, heights_px=slope)], 2, np.random.default_rng(3), OBLIQUE).camera
    assert float((flat - high).abs().mean()) > 0.01 and float((flat - hilly).abs().mean()) > 0.01


def test_augmentation_keeps_the_geometry_and_is_deterministic_per_seed() -> None:
    views = sample_views([sheet("a", 1), sheet("b", 2)], 4, np.random.default_rng(1), EVALUATION_RANGES)
    one, same, other = (augment_views(views, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one.camera, same.camera) and not torch.equal(one.camera, other.camera)
    assert float(one.camera.min()) >= 0.0 and float(one.camera.max()) <= 1.0
    assert one.place is views.place
    gradients = [normalise_contrast(v).mean(1).flatten(1) for v in (views.camera, one.camera)]
    correlation = torch.nn.functional.cosine_similarity(*gradients, dim=1).abs()
    assert float(correlation.median()) > 0.5  # the same pixels; a displaced image has no correlation


def test_the_true_place_has_the_best_score_of_all_maps_and_the_least_loss() -> None:
    sheets = [sheet(name, seed, dates=1) for seed, name in enumerate("abcdef")]
    views = sample_views(sheets, 3, np.random.default_rng(5), LEVEL)
    pool = torch.nn.AvgPool2d(STRIDE)
    scores = place_scores(pool(normalise_contrast(views.camera)), pool(normalise_contrast(views.ground)), views)
    assert scores.z.shape == (3, 3, OFFSETS, OFFSETS)
    for i in range(3):
        best = int(scores.z[i].argmax())
        assert best // OFFSETS**2 == i and float(scores.distance[i].flatten()[best % OFFSETS**2]) < 1.0
    elsewhere = replace(scores, distance=scores.distance.flip(1, 2))
    criterion = TrainingLoss()
    assert float(criterion.nats(scores).detach()) < float(criterion.nats(elsewhere).detach()) - 1.0


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
    views = sample_views([sheet("a", 1)], 2, np.random.default_rng(9))

    def loss(of: Training) -> float:
        with torch.no_grad():
            return float(of._criterion(of.network, views)[0])

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


def test_training_stops_when_the_held_out_places_gain_nothing_and_keeps_the_best_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = iter([2.0, 1.0, 3.0, 4.0, 5.0])
    monkeypatch.setattr(Training, "_held_out_nats", lambda _: next(found))
    monkeypatch.setattr(loop, "EVALUATION_EVERY", 1)
    monkeypatch.setattr(loop, "REPORT_EVERY", 1)
    monkeypatch.setattr(loop, "PATIENCE", 2)
    begun = training(tmp_path / "stop.pt")
    begun.recipe = replace(begun.recipe, steps=100)
    seen = {p.step: {k: v.clone() for k, v in begun.network.state_dict().items()} for p in begun.run(600.0)}
    assert begun.is_over and begun.step == 4
    best = begun.best_network().state_dict()
    assert all(torch.equal(best[name], seen[2][name]) for name in best)


@pytest.mark.filterwarnings("ignore::FutureWarning")  # of PyTorch's own exporter
def test_the_onnx_export_equals_the_network_and_replaces_xfeat(whole: Path, tmp_path: Path) -> None:
    network = training(whole).network.eval()
    made_from = {"name": "a.tif", "use": "trained on", "licence": 'mine, "all" of it', "sha256": "00"}
    path = export(network, tmp_path, ManifestText("tiny-own", "b", [made_from]))
    manifest = read(path.with_suffix(".toml"))
    assert manifest.role == "dense" and manifest.licence == 'mine, "all" of it'
    assert "trained on: a.tif, sha256 00" in path.with_suffix(".toml").read_text()
    describer = open_describer("tiny-own", str(tmp_path))
    picture = np.random.default_rng(1).integers(0, 255, (160, 224, 3), dtype=np.uint8)
    found = describer.describe(picture)
    assert found.shape == (16, 40, 56)
    tensor = torch.from_numpy(picture[:, :, ::-1].transpose(2, 0, 1).copy())[None].float() / 255
    with torch.no_grad():
        expected = network(tensor)[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert describer.describe(picture[:150, :200]).shape == (16, 37, 50)  # padded, and cropped again


def test_descriptors_of_a_map_tile_equal_those_of_the_whole_map() -> None:
    """Descriptors do not depend on the size of the image, because brightness is normalised locally."""
    torch.manual_seed(1)
    network = FeatureNetwork(16).eval()
    whole = sample_views([sheet("a", 1)], 1, np.random.default_rng(1), EVALUATION_RANGES).ground
    part = whole[:, :, 64:256, 64:256]
    with torch.no_grad():
        alike = torch.nn.functional.cosine_similarity(
            network(whole)[:, :, 32:48, 32:48], network(part)[:, :, 16:32, 16:32], dim=1
        )
    assert float(alike.min()) > 0.99
