"""Runs one phase of COLMAP through pycolmap: what the command of the same name does. gsscale-poses starts it."""

import sys

# Without the current folder: photos may lie beside a file that is called json.py.
sys.path[:] = [place for place in sys.path if place]

import json

import pycolmap


def device(uses_gpu):
    return pycolmap.Device.auto if uses_gpu else pycolmap.Device.cpu


def extract(database, photos, list_file, camera_model, one_camera, max_image_size, max_num_features, uses_gpu):
    with open(list_file) as file:
        names = file.read().splitlines()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = max_image_size
    extraction.sift.max_num_features = max_num_features
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database,
        photos,
        names,
        camera_mode=mode,
        reader_options=reader,
        extraction_options=extraction,
        device=device(uses_gpu),
    )


def match(database, pairs, uses_gpu):
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    pycolmap.match_image_pairs(database, pairing_options=pairing, device=device(uses_gpu))


def reconstruct(database, photos, model):
    pycolmap.incremental_mapping(database, photos, model)


def version():
    # Names that versions before 3.13 lack.
    if not hasattr(pycolmap, "FeatureExtractionOptions") or not hasattr(pycolmap, "match_image_pairs"):
        print("old pycolmap", pycolmap.__version__)
        return
    print("pycolmap", pycolmap.__version__, "with CUDA" if pycolmap.has_cuda else "")


if __name__ == "__main__":
    phase, arguments = sys.argv[1], json.loads(sys.argv[2])
    if phase != "version":
        pycolmap.logging.logtostderr = True
    {"features": extract, "matches": match, "model": reconstruct, "version": version}[phase](**arguments)
