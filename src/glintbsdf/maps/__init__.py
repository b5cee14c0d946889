"""Maps of normals: reading them, making them, and the seeded procedural maps.

The procedural maps are the public names of this package; see :mod:`glintbsdf.maps.procedural`.
"""

from glintbsdf.maps.procedural import (
    brushed,
    flakes,
    flat,
    isotropic,
    leather,
    scratched,
    tilted,
)

__all__ = ["brushed", "flakes", "flat", "isotropic", "leather", "scratched", "tilted"]
