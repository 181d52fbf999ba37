"""The methods of rtgs for nerfbaselines (https://nerfbaselines.github.io), in this Python: its backend `python`.

export NERFBASELINES_REGISTER=examples/nerfbaselines_method/rtgs_spec.py
nerfbaselines train --method rtgs-envgs --backend python --data FOLDER --preset standard
"""

import sys
from pathlib import Path

from nerfbaselines import register  # pyright: ignore[reportMissingImports]

sys.path.insert(0, str(Path(__file__).resolve().parent))  # of rtgs_method, which the specs name

METHODS = {
    "Surfels": "2D Gaussian splatting",
    "Ellipsoids": "3D Gaussian splatting",
    "DeferredReflection": "3D Gaussian splatting with deferred reflection",
    "EnvironmentGaussians": "EnvGS: reflections traced in Gaussians",
}

for name, title in METHODS.items():
    from_class = f"rtgs_method:{name}"
    method = __import__("rtgs_method").__dict__[name]
    register(
        {
            "id": method.method_id(),
            "method_class": from_class,
            "metadata": {"name": f"{title} (rtgs, on the CPU)", "licenses": [{"name": "MIT"}]},
            "backends_order": ["python"],
            "presets": {preset: {"preset": preset} for preset in ("smoke", "quick", "standard")},
            "required_features": sorted(method.get_method_info()["required_features"]),
            "supported_camera_models": ["pinhole"],
            "supported_outputs": ["color", "depth", "accumulation"],
            "implementation_status": {},
        }
    )
