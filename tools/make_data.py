"""Remake the computed files in data/: `.venv/bin/python tools/make_data.py`."""

import coursekit as ck
from coursekit.specifications import DATA


def readme_picture() -> None:
    """data/readme.png: what the simulated camera sees."""
    with ck.open_camera("simulated") as camera:
        picture = ck.plots.pinhole.frame(camera.frame())
    (DATA / "readme.png").write_bytes(picture.png())


if __name__ == "__main__":
    ck.cameras.conventions.store()
    readme_picture()
    print("data/vendor_models.json, data/readme.png")
