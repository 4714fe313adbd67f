"""Writes tests/fixtures/lpips.json: LPIPS distances by PyTorch of drawn pictures under drawn weights.

Needs PyTorch (1.13 made the committed file); the network is spelled out with torch.nn.functional, so neither
torchvision nor the lpips package nor any download is needed. tests/lpips.rs draws the same numbers.
"""
import json
import pathlib

import numpy as np
import torch
import torch.nn.functional as F

ALEX = [("slice1.0", 3, 64, 11, 4, 2, True), 3, ("slice2.3", 64, 192, 5, 1, 2, True), 3, ("slice3.6", 192, 384, 3, 1, 1, True),
        ("slice4.8", 384, 256, 3, 1, 1, True), ("slice5.10", 256, 256, 3, 1, 1, True)]
VGG = [("slice1.0", 3, 64, 3, 1, 1, False), ("slice1.2", 64, 64, 3, 1, 1, True), 2,
       ("slice2.5", 64, 128, 3, 1, 1, False), ("slice2.7", 128, 128, 3, 1, 1, True), 2,
       ("slice3.10", 128, 256, 3, 1, 1, False), ("slice3.12", 256, 256, 3, 1, 1, False), ("slice3.14", 256, 256, 3, 1, 1, True), 2,
       ("slice4.17", 256, 512, 3, 1, 1, False), ("slice4.19", 512, 512, 3, 1, 1, False), ("slice4.21", 512, 512, 3, 1, 1, True), 2,
       ("slice5.24", 512, 512, 3, 1, 1, False), ("slice5.26", 512, 512, 3, 1, 1, False), ("slice5.28", 512, 512, 3, 1, 1, True)]


def uniform(stream, count):
    """count numbers in 0..1: the upper 24 bits of SplitMix64's finaliser of (stream << 32) + i + 1."""
    with np.errstate(over="ignore"):
        z = (np.uint64(stream) << np.uint64(32)) + np.arange(1, count + 1, dtype=np.uint64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return (z >> np.uint64(40)).astype(np.float64) / 2**24


def distance(layers, a, b):
    stream, total = 100, 0.0
    for layer in layers:
        if isinstance(layer, int):
            a, b = F.max_pool2d(a, layer, 2), F.max_pool2d(b, layer, 2)
            continue
        _, inputs, outputs, kernel, stride, padding, tap = layer
        fan_in = inputs * kernel * kernel
        draw = uniform(stream, outputs * fan_in).reshape(outputs, inputs, kernel, kernel)
        # Kept at unit gain: uniform in +-sqrt(6 / fan_in), rounded to f32 as the file holds it.
        weight = torch.tensor(((2 * draw - 1) * np.sqrt(6 / fan_in)).astype(np.float32)).double()
        bias = torch.tensor((0.2 * uniform(stream + 1, outputs) - 0.1).astype(np.float32)).double()
        a, b = (F.relu(F.conv2d(x, weight, bias, stride, padding)) for x in (a, b))
        if tap:
            lin = torch.tensor(uniform(stream + 2, outputs).astype(np.float32)).double().reshape(1, -1, 1, 1)
            unit = [x / (torch.sqrt((x * x).sum(1, keepdim=True)) + 1e-10) for x in (a, b)]
            total += float((lin * (unit[0] - unit[1]) ** 2).sum(1).mean())
        stream += 3
    return total


def main():
    cases = []
    shift = torch.tensor([-0.030, -0.088, -0.188]).double().reshape(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).double().reshape(1, 3, 1, 1)
    for width, height in [(64, 64), (97, 45)]:
        photo = np.floor(uniform(1, 3 * width * height) * 256).reshape(height, width, 3) / 255
        noise = uniform(2, 3 * width * height).reshape(height, width, 3)
        render = (0.7 * photo + 0.3 * noise).astype(np.float32)
        a, b = (torch.tensor(x.astype(np.float64)).permute(2, 0, 1)[None] for x in (render, photo))
        for network, layers in [("alex", ALEX), ("vgg", VGG)]:
            for value_range in ("signed", "unit"):
                x, y = ((2 * p - 1 if value_range == "signed" else p) for p in (a, b))
                value = distance(layers, (x - shift) / scale, (y - shift) / scale)
                cases.append({"network": network, "range": value_range, "width": width, "height": height, "distance": value})
    path = pathlib.Path(__file__).parent.parent / "fixtures" / "lpips.json"
    path.write_text(json.dumps({"torch": torch.__version__, "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    with torch.no_grad():
        main()
