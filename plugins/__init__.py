r"""Mitsuba plugins, one module each, named after the plugin's type.

The docstring of each is its documentation page. The parameters that a page calls *Shared* are
described here, once:

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
   - The map as a tensor of H×W×C values, C = 1…4, instead of :monosp:`filename`. Exposed is the map
     in use: the projected normals, H×W×2.
   - |exposed|, |differentiable|

 * - layer
   - |string|
   - Layer of an OpenEXR file that has several. (Default: one called "normal", or "height" for a
     height; else the layer without a name)

 * - map_type
   - |string|
   - What the map holds: :monosp:`normal`, (x, y) or (x, y, z); :monosp:`height`, which gives the
     facets of the displaced surface; or :monosp:`auto`, a height where there is one channel or
     three that are equal but for a few levels. See :doc:`/maps`. (Default: :monosp:`auto`)

 * - height_scale
   - |float|
   - Texels per unit of height, from −1e9 to 1e9; integers are fractions of their range.
     (Default: 1)

 * - encoding
   - |string|
   - How components of normals are stored: :monosp:`signed`, in [−1, 1]; :monosp:`unsigned`, as
     (n + 1)/2; or :monosp:`auto`, as the numbers look, whatever the file's type. What was decided
     is logged where the type alone would not tell. (Default: :monosp:`auto`)

 * - flip_y
   - |bool|
   - Whether green points down in the image, as DirectX has it, rather than up. Where it is not
     given and the normals of the map speak for it, there is a warning. (Default: |false|)

 * - strength
   - |float|
   - Factor on the slopes of the map, from 0 to 1000. (Default: 1)

 * - fill_voids
   - |bool|
   - Whether texels that hold nothing take the normal of the nearest texel that does, rather than
     being refused. Such are NaN, the black or transparent padding of an atlas, and a height's
     −9999, −32767, −32768 or the value that the file names. Their number is logged.
     (Default: |false|)

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
   - Standard deviation of the footprint, in pixels, from 0 to 100. (Default: 0.5)
   - |exposed|, |differentiable|, |discontinuous|

 * - pixel_spread
   - |float|
   - Angle of a pixel in radians, divided by the square root of the samples per pixel, as Mitsuba
     scales ray differentials. The footprint follows from it where the integrator gives none:
     Mitsuba's own integrators give none, :ref:`glint_path <integrator-glint_path>` does, and
     :monosp:`glintbsdf render` sets this parameter by itself. From 0 to π. (Default: 0)
   - |exposed|, |differentiable|, |discontinuous|

 * - material
   - |string|
   - Name of a metal, as in :monosp:`roughconductor`. (Default: :monosp:`none`, a perfect mirror)

 * - eta, k
   - |spectrum| or |texture|
   - Real and imaginary part of the index of refraction, from 0 to 1000, instead of
     :monosp:`material`.
     (Default: 0 and 1 where only the other is given)
   - |exposed|, |differentiable|, |discontinuous|

 * - int_ior, ext_ior
   - |float| or |string|
   - Indices of refraction inside and outside of a dielectric, from 0.001 to 1000, or names such as
     :monosp:`bk7`, instead of a metal. Only its reflection is modelled: what is transmitted is
     absorbed. (Default: :monosp:`bk7` and :monosp:`air` where only the other is given)

 * - specular_reflectance
   - |spectrum| or |texture|
   - Factor on the reflection, in [0, 1]. (Default: 1)
   - |exposed|, |differentiable|

:mod:`glintbsdf.bridge.registration` imports these modules anew in each JIT variant.
"""
