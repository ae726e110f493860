"""What a rule reads besides the frame is part of its key: files of its options, helper modules,
networks."""

import functools
import importlib
import sys

import pytest
import torch

from gsfusion_nb.code_keys import rule_fingerprint
from gsfusion_nb.compare import Entrant
from gsfusion_nb.compare.one_run import run_entry
from gsfusion_nb.compare.run_all import ResultStore, run_all

LEARNED = '''
import functools
from pathlib import Path

import torch

from gsfusion_nb.seeding import SeedContext, Seeds


@functools.cache
def network(weights: Path) -> torch.nn.Module:
    net = torch.nn.Conv2d(3, 1, 1)
    net.load_state_dict(torch.load(weights, weights_only=True))
    return net.eval()


@torch.no_grad()
def learned(ctx: SeedContext, *, weights: Path = Path("{place}"), where: str = "anywhere") -> Seeds:
    """Seeds where a small network says so."""
    score = network(weights)(ctx.frame.rgb.permute(2, 0, 1)[None])[0, 0]
    return ctx.seeds_at(ctx.pixels(score > 0), 1.0)


'''
HELPER = "SCALE = {scale}\n\n\ndef radius():\n    return SCALE\n"


def write_weights(path, bias):
    net = torch.nn.Conv2d(3, 1, 1)
    net.load_state_dict(
        {"weight": torch.tensor([1.0, -1.0, 0.5]).view(1, 3, 1, 1), "bias": torch.tensor([bias])}
    )
    torch.save(net.state_dict(), path)


@pytest.fixture
def learned(tmp_path):
    """File of the rule, and of its weights."""
    file = tmp_path / "learned_rule.py"
    weights = tmp_path / "w.pt"
    write_weights(weights, 0.0)
    file.write_text(LEARNED.replace("{place}", str(weights)))
    return file, weights


@pytest.fixture
def entry(spec):
    """``entry(rule, options)``: a run of a rule on the small scene."""
    plain = spec()
    fields = {name: getattr(plain, name) for name in ("scene", "data", "settings")}
    return lambda rule, options=None: Entrant(rule, options or {}).entry(**fields)


@pytest.mark.ci
def test_retrained_weights_give_another_key_and_another_map(learned, entry, tmp_path):
    file, weights = learned
    store = ResultStore(tmp_path / "cache")
    hashes = []
    for bias in (0.0, -0.2):
        write_weights(weights, bias)
        ((_, result),) = run_all([entry(f"{file}:learned")], store)
        assert result.reason == ""
        hashes.append((result.key, result.map_hash))
    assert hashes[0][0] != hashes[1][0] == entry(f"{file}:learned").spec.key
    assert hashes[0][1] != hashes[1][1]
    other = tmp_path / "other.pt"
    write_weights(other, 0.1)
    assert entry(f"{file}:learned", {"weights": other}).spec.key not in {key for key, _ in hashes}


def test_weights_that_change_after_the_key_was_made_fail_the_run(learned, entry):
    file, weights = learned
    made = entry(f"{file}:learned")
    write_weights(weights, 1.0)
    assert "weights" in run_entry(made).reason
    weights.unlink()
    with pytest.raises(FileNotFoundError, match=r"weights.*w\.pt"):
        entry(f"{file}:learned")


def test_the_values_of_a_global_network_are_part_of_the_fingerprint():
    prints = []
    for value in (0.0, 1.0):
        net = torch.nn.Conv2d(3, 1, 1)
        for parameter in net.parameters():
            torch.nn.init.constant_(parameter, value)
        prints += [
            rule_fingerprint(lambda ctx, net=net: net(ctx)),
            rule_fingerprint(functools.partial(pow, value)),
        ]
    assert len(set(prints)) == 4


@pytest.mark.parametrize("how", ["import the_helper\n", "from the_helper import radius\n", ""])
def test_a_helper_module_is_part_of_the_key(how, entry, tmp_path, monkeypatch):
    call = "radius()" if "from" in how else "the_helper.radius()"
    inside = "" if how else "    import the_helper\n"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "the_helper", raising=False)
    file = tmp_path / "rule.py"
    helper = tmp_path / "the_helper.py"
    keys = []
    file.write_text(
        f"{how}\n\ndef helped(ctx):\n{inside}    return ctx.seeds_at(ctx.pixels()[::7], {call})  # "
        f"{how!r}\n"
    )
    for scale in (1.5, 22.5):
        helper.write_text(HELPER.format(scale=scale))
        importlib.invalidate_caches()
        for name in [
            name for name in sys.modules if name == "the_helper" or name.startswith("code_file_")
        ]:
            monkeypatch.delitem(sys.modules, name)
        keys.append(entry(f"{file}:helped").spec.key)
    assert keys[0] != keys[1]
