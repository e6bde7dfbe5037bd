"""The network: what Table III promises, invariances, and the temporal layer against torch's own."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor, nn

from pred_core.errors import ConfigError, TwinError
from pred_core.residual import Motion, ResidualConfig, binding_share, build_network, load_network
from pred_core.residual.encoder import Encoder
from pred_core.residual.network import Buffer, ResidualNetwork
from pred_core.residual.temporal import Temporal

SMALL = ResidualConfig(feature=16, hidden=16, embedding=16, feedforward=32, encoder_feedforward=32, encoder_layers=2)


def randomised(config: ResidualConfig, seed: int = 0) -> ResidualNetwork:
    """A network with no zero layer, as after training."""
    network = build_network(config, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator)
    return network


def motion(batch: int, count: int, seed: int = 0) -> Motion:
    generator = torch.Generator().manual_seed(seed)
    return Motion(*(torch.rand(batch, count, 3, generator=generator) for _ in range(6)))


def test_defaults_are_table_three() -> None:
    config = ResidualConfig()
    assert (config.feature, config.channels, config.hidden_layers, config.hidden) == (64, 18, 2, 64)
    assert (config.embedding, config.heads, config.temporal_layers, config.feedforward) == (64, 4, 2, 128)
    assert (config.window, config.cap, config.decoder) == (5, 0.1, True)
    network = build_network(config, 0)
    assert network.encoder.embed.weight.shape == (64, 18)
    assert network.decoder.out.weight.shape == (3, 64)


def test_untrained_network_adds_nothing() -> None:
    network = build_network(SMALL, 0)
    residual, _ = network(motion(2, 9), Buffer.empty(2, 5, torch.zeros(2, 9, 3)), 0.01, torch.linspace(0, 1, 9))
    assert residual.eq(0).all()


@pytest.mark.parametrize("decoder", [True, False])
def test_output_never_leaves_the_cap(decoder: bool) -> None:
    network = randomised(dataclasses.replace(SMALL, cap=0.02, decoder=decoder))
    buffer = Buffer.empty(2, 5, torch.zeros(2, 9, 3))
    wild = Motion(*(100.0 * getattr(motion(2, 9), f.name) for f in dataclasses.fields(Motion)))
    for _ in range(7):
        residual, buffer = network(wild, buffer, 0.01, torch.linspace(0, 1, 9))
        assert residual.abs().max() <= 0.02
    assert residual.abs().max() > 0.001


def test_permuting_particles_permutes_the_output() -> None:
    # 150 particles in patches of 50 and 150 random positions: no two share a cell on every curve, so the
    # patches do not depend on the index; float32 sums in another order differ by about 1e-6.
    network = randomised(dataclasses.replace(SMALL, cap=1.0))
    moves = motion(1, 150)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(3))
    shuffled = Motion(*(getattr(moves, f.name)[:, order] for f in dataclasses.fields(Motion)))
    arc = torch.linspace(0, 1, 150)
    with torch.no_grad():
        plain, _ = network(moves, Buffer.empty(1, 5, moves.position), 0.1, arc)
        mixed, _ = network(shuffled, Buffer.empty(1, 5, moves.position), 0.1, arc[order])
    assert torch.allclose(plain[:, order], mixed, atol=1e-4)
    assert plain.std() > 1e-2


@pytest.mark.parametrize("count", [13, 64, 150])
def test_batch_equals_loop(count: int) -> None:
    network, moves = randomised(SMALL), motion(3, count)
    arc = torch.linspace(0, 1, count)
    with torch.no_grad():
        whole, buffer = network(moves, Buffer.empty(3, 5, moves.position), 0.1, arc)
        for b in range(3):
            one = Motion(*(getattr(moves, f.name)[b : b + 1] for f in dataclasses.fields(Motion)))
            alone, kept = network(one, Buffer.empty(1, 5, one.position), 0.1, arc)
            assert torch.allclose(alone[0], whole[b], atol=1e-5)
            assert torch.allclose(kept.window[0], buffer.window[b], atol=1e-5)


def test_patch_borrowing_covers_every_point_once() -> None:
    # 130 points in patches of at most 64: three of 48 (44 in whole lanes of 8), the last borrows 14 points.
    encoder = Encoder(dataclasses.replace(SMALL, patch=64, encoder_layers=1))
    position = torch.rand(1, 130, 3, generator=torch.Generator().manual_seed(0))
    channels = torch.randn(1, 130, 18, generator=torch.Generator().manual_seed(1)).requires_grad_()
    features = encoder(channels, position)
    for i in (0, 60, 129):
        (gradient,) = torch.autograd.grad(features[0, i, 0], channels, retain_graph=True)
        reached = gradient[0].abs().sum(-1) > 0
        assert reached[i] and 48 <= int(reached.sum()) <= 54  # its patch and 3 serial neighbours on each side


def test_translation_changes_nothing_with_centered_coordinates() -> None:
    network = randomised(dataclasses.replace(SMALL, coordinates="centered"))
    moves, shift = motion(1, 20), torch.tensor([0.5, -1.0, 2.0])
    moved = dataclasses.replace(
        moves,
        position=moves.position + shift,
        past_position=moves.past_position + shift,
        predicted_position=moves.predicted_position + shift,
    )
    arc = torch.linspace(0, 1, 20)
    with torch.no_grad():
        a, _ = network(moves, Buffer.empty(1, 5, moves.position), 0.1, arc)
        b, _ = network(moved, Buffer.empty(1, 5, moves.position), 0.1, arc)
    assert torch.allclose(a, b, atol=1e-4)  # positions of 2 m carry 2e-7; amplified by 1 / period and five octaves


def test_window_repeats_the_newest_until_it_is_full() -> None:
    buffer = Buffer.empty(1, 3, torch.zeros(1, 1, 3))
    seen = []
    for value in (1.0, 2.0, 3.0, 4.0):
        buffer = buffer.push(torch.full((1, 1, 3), value))
        seen.append(buffer.window[0, :, 0, 0].tolist())
    assert seen == [[1, 1, 1], [1, 2, 2], [1, 2, 3], [2, 3, 4]]
    assert buffer.count.tolist() == [3]


def reference_hidden(temporal: Temporal, steps: Tensor) -> Tensor:
    """The same parameters in torch's own post-norm encoder layers, every token computed."""
    x = temporal.embed(steps).transpose(0, 1) + temporal.slots
    for layer in temporal.layers:
        width, feed = layer.out.in_features, layer.feed_in.out_features
        plain = nn.TransformerEncoderLayer(width, layer.heads, feed, dropout=0.0, batch_first=True).eval()
        plain.load_state_dict(
            {
                "self_attn.in_proj_weight": layer.qkv.weight, "self_attn.in_proj_bias": layer.qkv.bias,
                "self_attn.out_proj.weight": layer.out.weight, "self_attn.out_proj.bias": layer.out.bias,
                "linear1.weight": layer.feed_in.weight, "linear1.bias": layer.feed_in.bias,
                "linear2.weight": layer.feed_out.weight, "linear2.bias": layer.feed_out.bias,
                "norm1.weight": layer.norm_attention.weight, "norm1.bias": layer.norm_attention.bias,
                "norm2.weight": layer.norm_feed.weight, "norm2.bias": layer.norm_feed.bias,
            }
        )  # fmt: skip
        x = plain(x)
    return x[:, -1]


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_temporal_rewriting_equals_the_textbook_transformer(layers: int) -> None:
    temporal = randomised(dataclasses.replace(SMALL, temporal_layers=layers)).temporal
    steps = torch.randn(5, 40, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected, got = reference_hidden(temporal, steps), temporal.hidden(steps)
    assert torch.allclose(expected, got, atol=2e-5)  # float32, layer-normalised features of size 1
    assert expected.std() > 0.1


def test_gate_blends_initial_and_offset() -> None:
    # Projections replaced by constants: g = 1/(1+e^0) = 0.5, delta = tanh(atanh(0.6)) = 0.6, initial 0.2 -> 0.4.
    temporal = build_network(SMALL, 0).temporal
    with torch.no_grad():
        for linear, bias in ((temporal.gate, 0.0), (temporal.offset, 0.6931472)):
            linear.weight.zero_()
            linear.bias.fill_(bias)
        out = temporal(torch.full((1, 5, 2, 3), 0.2))
    assert torch.allclose(out, torch.full((1, 2, 3), 0.4), atol=1e-6)


def test_binding_share_counts_free_components() -> None:
    residual = torch.tensor([[0.1, 0.0, -0.096], [0.094, 0.1, 0.1]])
    assert float(binding_share(residual, torch.tensor([True, False]), 0.1)) == pytest.approx(2 / 3)
    assert float(binding_share(residual, torch.tensor([True, True]), 0.1)) == pytest.approx(4 / 6)


def test_weights_survive_the_twin_and_wrong_ones_are_refused() -> None:
    network = randomised(SMALL)
    weights = network.weights()
    again = load_network(weights)
    assert all(a.equal(b) for a, b in zip(network.state_dict().values(), again.state_dict().values(), strict=True))
    with pytest.raises(TwinError, match="do not fit"):
        load_network(dataclasses.replace(weights, config={**weights.config, "feature": 32}))
    broken = {**weights.tensors, "encoder.embed.bias": torch.full((16,), float("nan"))}
    with pytest.raises(TwinError, match="encoder.embed.bias"):
        load_network(dataclasses.replace(weights, tensors=broken))


def test_sizes_are_checked() -> None:
    with pytest.raises(ConfigError, match="feature"):
        build_network(ResidualConfig(feature=66), 0)
    with pytest.raises(ConfigError, match="cap"):
        build_network(ResidualConfig(cap=0.0), 0)
