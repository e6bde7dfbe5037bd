"""Time of one residual step against its own floating-point floor, and the temporal part against torch's layers.

    python benchmarks/residual_inference.py [--particles 1000] [--batch 1] [--device cpu] [--rounds 15]

The floor is the floating-point operations of the network, counted from its sizes, over the rate of a large
matrix product measured in the same process between the rounds. Nothing can be faster at that rate.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

from pred_core.residual import Motion, ResidualConfig, ResidualNetwork, build_network
from pred_core.residual.encoder import _patches
from pred_core.residual.network import Buffer
from pred_core.residual.temporal import TemporalLayer


def operations(config: ResidualConfig, count: int) -> dict[str, float]:
    """Floating-point operations (2 per multiply-add) of the matrix products of one cloud, by part."""
    f, inner, d, w, h = config.feature, config.encoder_feedforward, config.embedding, config.window, config.heads
    size, take, _ = _patches(count, config.patch, torch.device("cpu"))
    neighbours = 2 * config.reach + 1
    block = count * (4 * f * f + 2 * f * inner + neighbours * 5 * f) + len(take) * 2 * size * f
    encoder = count * config.channels * f + config.encoder_layers * block
    widths = [f + 6 * config.frequencies] + [config.hidden] * config.hidden_layers + [3]
    decoder = count * sum(a * b for a, b in zip(widths[:-1], widths[1:], strict=True))
    feed = 2 * d * config.feedforward
    first = w * (w * h * 16 + w * h * 3 + h * (3 + w) * d + feed)
    middle = w * (4 * d * d + 2 * w * d + feed)
    last = 4 * d * d + 2 * w * h * d + feed
    inner_layers = first + max(0, config.temporal_layers - 2) * middle if config.temporal_layers > 1 else 0
    temporal = count * (w * 3 * d + inner_layers + last + 6 * d)
    return {"encoder": 2.0 * encoder, "decoder": 2.0 * decoder, "temporal": 2.0 * temporal}


def textbook_temporal(network: ResidualNetwork) -> Callable[[Tensor], Tensor]:
    """The same temporal part in `torch.nn.TransformerEncoderLayer`, every token computed."""
    temporal = network.temporal
    plain: list[nn.Module] = []
    for layer in cast(list[TemporalLayer], list(temporal.layers)):
        other = nn.TransformerEncoderLayer(
            layer.out.in_features, layer.heads, layer.feed_in.out_features, 0.0, batch_first=True
        )
        names = {"qkv": "self_attn.in_proj_", "out": "self_attn.out_proj.", "feed_in": "linear1.",
                 "feed_out": "linear2.", "norm_attention": "norm1.", "norm_feed": "norm2."}  # fmt: skip
        own = layer.state_dict()
        other.load_state_dict({names[k.split(".")[0]] + k.split(".")[1]: v for k, v in own.items()})
        plain.append(other.to(temporal.embed.weight.device).eval())

    def run(window: Tensor) -> Tensor:
        x = temporal.embed(window.permute(0, 2, 1, 3).flatten(0, 1)) + temporal.slots
        for other in plain:
            x = other(x)
        hidden = x[:, -1]
        gate = torch.sigmoid(temporal.gate(hidden))
        newest = window[:, -1].flatten(0, 1)
        return torch.lerp(newest, torch.tanh(temporal.offset(hidden)), gate).view(window[:, -1].shape)

    return run


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.backends.cuda.matmul.allow_tf32 = False
    device, generator = torch.device(args.device), torch.Generator().manual_seed(0)
    config = ResidualConfig()
    network = build_network(config, 0).to(device).eval()
    with torch.no_grad():  # an untrained network outputs exact zeros; equality would show nothing
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator).to(device))
    shape = (args.batch, args.particles, 3)
    moves = Motion(*(torch.rand(shape, generator=generator).to(device) for _ in range(6)))
    buffer = Buffer.empty(args.batch, config.window, moves.position)
    arc = torch.linspace(0, 1, args.particles, device=device)
    channels = torch.randn(*shape[:2], config.channels, generator=generator).to(device)
    feature = torch.randn(*shape[:2], config.feature, generator=generator).to(device)
    window = torch.randn(args.batch, config.window, *shape[1:], generator=generator).to(device)
    textbook = textbook_temporal(network)
    side = 2048 if device.type == "cpu" else 8192
    a, b = (torch.randn(side, side, generator=generator).to(device) for _ in range(2))
    parts: dict[str, Callable[[], object]] = {
        "step": lambda: network(moves, buffer, 0.01, arc),
        "encoder": lambda: network.encoder(channels, moves.position),
        "decoder": lambda: network.decoder(feature, moves.position),
        "temporal": lambda: network.temporal(window),
        "temporal, torch's layers": lambda: textbook(window),
        "matrix product": lambda: a @ b,
    }
    with torch.inference_mode():
        torch.testing.assert_close(network.temporal(window), textbook(window), atol=1e-4, rtol=1e-4)
        times: dict[str, list[float]] = {name: [] for name in parts}
        for part in parts.values():
            part()
        for _ in range(args.rounds):
            for name, part in parts.items():
                times[name].append(seconds(part, device))
    rate = 2.0 * side**3 / min(times["matrix product"])
    counted = {k: v * args.batch for k, v in operations(config, args.particles).items()}
    counted["step"] = sum(counted.values())
    parameters = sum(p.numel() for p in network.parameters())
    print(f"{args.batch} x {args.particles} particles, {args.device}, {args.threads} thread(s)")
    print(f"{parameters} parameters, fp32, {args.rounds} alternating rounds")
    print(f"matrix product of {side}: {rate / 1e9:.1f} GFLOP/s")
    print(f"{'part':28}{'min [ms]':>10}{'median':>10}{'MFLOP':>10}{'floor [ms]':>12}{'min/floor':>11}")
    for name in list(parts)[:-1]:
        low, middle = 1e3 * min(times[name]), 1e3 * statistics.median(times[name])
        tail = ""
        if name in counted:
            floor = 1e3 * counted[name] / rate
            tail = f"{counted[name] / 1e6:10.1f}{floor:12.3f}{low / floor:11.2f}"
        print(f"{name:28}{low:10.3f}{middle:10.3f}{tail}")
    pairs = [t / o for t, o in zip(times["temporal, torch's layers"], times["temporal"], strict=True)]
    least = min(times["temporal, torch's layers"]) / min(times["temporal"])
    paired = statistics.median(pairs)
    print(f"temporal, torch's layers over ours: {least:.2f} (min over min), {paired:.2f} (median pair)")


def seconds(part: Callable[[], object], device: torch.device) -> float:
    """Time of one call, device work included."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    begin = time.perf_counter()
    part()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - begin


if __name__ == "__main__":
    main()
