r"""Mitsuba plugins, one module each, named after the plugin's type.

The docstring of each is its documentation page. What a page calls *Shared* is here, once:

.. pluginparameters::

 * - filename
   - |string|
   - Image file of the normal or height map: OpenEXR, PNG, TIFF and what else Mitsuba reads. A
     relative name counts from the scene's folder.

 * - bitmap
   - :monosp:`mitsuba.Bitmap`
   - The map itself, instead of :monosp:`filename`, when the scene is built in Python.

 * - data
   - |tensor|
   - The map as a tensor of H×W×C values, C = 1…4, instead of :monosp:`filename`. What is exposed is
     the map in use: the projected normals, H×W×2.
   - |exposed|, |differentiable|

 * - map_type
   - |string|
   - What the map holds: :monosp:`normal`, (x, y) or (x, y, z) in [−1, 1]; :monosp:`height`, which
     gives normals ∝ (−∂h/∂x, −∂h/∂y, 1); or :monosp:`auto`, a height where there is one channel or
     all channels are equal. Files of unsigned integers are decoded from [0, 1].
     (Default: :monosp:`auto`)

 * - height_scale
   - |float|
   - Texels per unit of height. (Default: 1)

 * - wrap_mode
   - |string|
   - What lies beyond the map's border: :monosp:`repeat`, :monosp:`mirror` or :monosp:`clamp`.
     (Default: :monosp:`repeat`)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. (Default: none)
   - |exposed|

 * - footprint_sigma
   - |float|
   - Standard deviation of the footprint, in pixels. (Default: 0.5)
   - |exposed|, |differentiable|, |discontinuous|

 * - pixel_spread
   - |float|
   - Angle of a pixel in radians, divided by the square root of the samples per pixel, as Mitsuba
     scales ray differentials. The footprint follows from it where the integrator gives none:
     Mitsuba's own integrators give none, :ref:`glint_path <integrator-glint_path>` does, and
     :monosp:`glintbsdf render` sets this parameter by itself. (Default: 0)
   - |exposed|, |differentiable|, |discontinuous|

 * - material
   - |string|
   - Name of a metal, as in :monosp:`roughconductor`. (Default: :monosp:`none`, a perfect mirror)

 * - eta, k
   - |spectrum| or |texture|
   - Real and imaginary part of the index of refraction, instead of :monosp:`material`.
     (Default: 0 and 1 where only the other is given)
   - |exposed|, |differentiable|, |discontinuous|

 * - int_ior, ext_ior
   - |float| or |string|
   - Indices of refraction inside and outside of a dielectric, or names such as :monosp:`bk7`,
     instead of a metal. Only its reflection is modelled: what is transmitted is absorbed. (Default:
     :monosp:`bk7` and :monosp:`air` where only the other is given)

 * - specular_reflectance
   - |spectrum| or |texture|
   - Factor on the reflection, in [0, 1]. (Default: 1)
   - |exposed|, |differentiable|

:mod:`glintbsdf.bridge.registration` imports these modules anew in each JIT variant.
"""
