"""Writes tests/fixtures/mega_nerf: coordinates.pt and two files of metadata by PyTorch's own torch.save, and expected.json.

The poses are made as Mega-NeRF's conversion from COLMAP does: camera and world axes down-right-back, then the camera's
columns permuted. Needs PyTorch (1.13 made the committed files).
"""
import json
import math
import pathlib

import torch

RDF_TO_DRB = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]).double()


def main():
    folder = pathlib.Path(__file__).parent.parent / "fixtures" / "mega_nerf"
    origin, scale = torch.tensor([-120.5, 33.25, 8.0]).double(), 151.75
    torch.save({"origin_drb": origin, "pose_scale_factor": scale}, folder / "coordinates.pt")
    expected = []
    for i, (yaw, pitch, centre) in enumerate([(0.3, -1.2, [4.0, 50.0, 130.0]), (2.2, -0.9, [-60.0, 20.0, 110.0])]):
        a, b = math.cos(yaw), math.sin(yaw)
        c, d = math.cos(pitch), math.sin(pitch)
        c2w = torch.tensor([[a, -b, 0], [b, a, 0], [0, 0, 1.0]]).double() @ torch.tensor([[1.0, 0, 0], [0, c, -d], [0, d, c]]).double()
        centre = torch.tensor(centre).double()
        drb = RDF_TO_DRB @ c2w @ torch.inverse(RDF_TO_DRB)
        at = (RDF_TO_DRB @ centre - origin) / scale
        c2w_file = torch.cat([drb[:, 1:2], -drb[:, :1], drb[:, 2:3], at[:, None]], -1)
        torch.save({"W": 96, "H": 64, "intrinsics": torch.tensor([80.5, 81.5, 48.0, 32.0]), "c2w": c2w_file.float(),
                    "distortion": torch.zeros(4)}, folder / f"{i:06}.pt")
        # World to camera (right-down-forward), the world being down-right-back in metres.
        world = RDF_TO_DRB
        rotation = (world @ c2w).T
        expected.append({"rotation": rotation.tolist(), "centre": (world @ centre).tolist()})
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
