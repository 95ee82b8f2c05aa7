"""LPIPS against TorchMetrics, with random features: the published ones are not ours to ship."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torchmetrics.functional.image.lpips as theirs
from safetensors.torch import save_file

from mass_engine.errors import EngineError
from mass_engine.evaluation.lpips import CONVENTIONS, Lpips, LpipsSet, Network
from tests.engine.evaluation.test_metrics import pair


def features(name: str, _pretrained: bool) -> torch.nn.Sequential:
    """The published feature stacks (Krizhevsky 2014; Simonyan and Zisserman 2015), random."""
    torch.manual_seed(3)
    layers: list[torch.nn.Module] = []
    if name == "alexnet":
        plan: list[tuple[int, int, int, int] | str] = [(64, 11, 4, 2), "M", (192, 5, 1, 2), "M"]
        plan += [(384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1), "M"]
        pool = 3
    else:
        widths = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0)
        plan = [(width, 3, 1, 1) if width else "M" for width in widths]
        pool = 2
    before = 3
    for step in plan:
        if isinstance(step, str):
            layers.append(torch.nn.MaxPool2d(pool, 2))
        else:
            width, size, stride, edge = step
            layers += [torch.nn.Conv2d(before, width, size, stride, edge), torch.nn.ReLU()]
            before = width
    return torch.nn.Sequential(*layers)


def published(network: Network, monkeypatch: pytest.MonkeyPatch) -> torch.nn.Module:
    """TorchMetrics' copy of the metric, with the authors' linear layers on random features."""
    monkeypatch.setattr(theirs, "_get_tv_model_features", features)
    model = theirs._LPIPS(net=network)
    assert isinstance(model, torch.nn.Module)
    return model


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_lpips_agrees_with_torchmetrics(
    network: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric = published(network, monkeypatch)
    torch.save(metric.state_dict(), tmp_path / "weights.pth")
    kept = {name: value for name, value in metric.state_dict().items() if not name.startswith("lins.")}
    save_file(kept, tmp_path / "weights.safetensors")
    a, b = (picture.float() for picture in pair(80))
    planes = [picture.permute(2, 0, 1)[None] for picture in (a, b)]
    with torch.no_grad():
        plain, stretched = (float(metric(*planes, normalize=stretch)) for stretch in (False, True))
    assert abs(plain - stretched) > 1e-3 * plain  # the conventions are not the same
    for name in ("weights.pth", "weights.safetensors"):
        ours = Lpips.load(tmp_path / name)
        assert ours.network == network
        assert abs(ours(a, b, stretch=False) - plain) < 1e-5 * plain
        assert abs(ours(a, b, stretch=True) - stretched) < 1e-5 * stretched
        assert ours(a, a, stretch=True) == 0.0
    scores = LpipsSet.load([tmp_path / "weights.pth"]).scores(a, b)
    assert {key for key, value in scores.items() if value is not None} == {
        key for key, (used, _) in CONVENTIONS.items() if used == network
    }


def test_without_weights_nothing_is_computed() -> None:
    assert LpipsSet({}).scores(*pair(80)) == dict.fromkeys(CONVENTIONS)


def test_other_files_are_refused(tmp_path: Path) -> None:
    def code(path: Path) -> str:
        with pytest.raises(EngineError) as caught:
            Lpips.load(path)
        return caught.value.code

    assert code(tmp_path / "none.pth") == "lpips.not_found"
    (tmp_path / "text.pth").write_text("no weights")
    assert code(tmp_path / "text.pth") == "lpips.invalid"
    torch.save([1, 2], tmp_path / "list.pth")
    assert code(tmp_path / "list.pth") == "lpips.invalid"
    torch.save({"net.slice1.0.weight": torch.zeros(64, 3, 3, 3)}, tmp_path / "part.pth")
    assert code(tmp_path / "part.pth") == "lpips.invalid"
    save_file({"net.slice1.0.weight": torch.zeros(2, 2)}, tmp_path / "other.safetensors")
    assert code(tmp_path / "other.safetensors") == "lpips.invalid"
