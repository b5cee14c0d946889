r"""Mitsuba plugins, one module each, named after the plugin's type.

The docstring of each module is its documentation page. Parameters that a page calls *Shared* are
described here:

.. pluginparameters::

 * - filename
   - |string|
   - Image file of the normal or height map: OpenEXR, PNG, TIFF, or any other format that Mitsuba
     reads. A relative name is relative to the scene's folder. The file of the examples on these
     pages comes from ``glintbsdf example scratched``.

 * - bitmap
   - :monosp:`mitsuba.Bitmap`
   - The map itself, instead of :monosp:`filename`, if the scene is built in Python.

 * - data
   - |tensor|
   - The map as a tensor of H×W×C values, C = 1…4, instead of :monosp:`filename`. The exposed
     parameter has the projected normals in use, H×W×2.
   - |exposed|, |differentiable|

 * - layer
   - |string|
   - Layer of an OpenEXR file with several layers. (Default: one called "normal", or "height" for a
     height; else the layer without a name)

 * - map_type
   - |string|
   - Content of the map. :monosp:`normal`: components (x, y) or (x, y, z). :monosp:`height`:
     heights, which give the facets of the displaced surface. :monosp:`auto`: a height if there is
     one channel, or three that are equal but for a few levels; otherwise normals. See :doc:`/maps`.
     (Default: :monosp:`auto`)

 * - height_scale
   - |float|
   - Texels per unit of height, from −1e9 to 1e9. Integer heights are fractions of their range.
     (Default: 1)

 * - encoding
   - |string|
   - Encoding of the components of normals: :monosp:`signed`, in [−1, 1]; :monosp:`unsigned`, as
     (n + 1)/2; or :monosp:`auto`, which decides by the numbers, whatever the file's type. The
     decision is logged if the type alone would not tell. (Default: :monosp:`auto`)

 * - flip_y
   - |bool|
   - Whether green points down in the image, as in DirectX, rather than up. If it is not given, but
     the normals of the map suggest that it should be true, there is a warning. (Default: |false|)

 * - strength
   - |float|
   - Factor on the slopes of the map, from 0 to 1000. (Default: 1)

 * - fill_voids
   - |bool|
   - Whether empty texels take the normal of the nearest texel that is not empty; otherwise they are
     an error. Empty texels are NaN, the black or transparent padding of an atlas, and heights of
     −9999, −32767, −32768 or the value that the file declares. Their number is logged.
     (Default: |false|)

 * - wrap_mode
   - |string|
   - Continuation beyond the map's border: :monosp:`repeat`, :monosp:`mirror` or :monosp:`clamp`.
     (Default: :monosp:`repeat`)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. It is invertible, and its entries
     are at most 1e7. (Default: none)
   - |exposed|

 * - footprint_sigma
   - |float|
   - Standard deviation of the footprint, in pixels, from 0 to 100. (Default: 0.5)
   - |exposed|, |differentiable|, |discontinuous|

 * - pixel_spread
   - |float|
   - Angle of a pixel in radians, divided by the square root of the samples per pixel, as Mitsuba
     scales ray differentials; from 0 to π. The footprint follows from it if the integrator gives no
     footprint. Mitsuba's own integrators give none, :ref:`glint_path <integrator-glint_path>` does.
     :monosp:`glintbsdf render` sets this parameter automatically. (Default: 0)
   - |exposed|, |differentiable|, |discontinuous|

 * - material
   - |string|
   - Name of a metal, as in :monosp:`roughconductor`. (Default: :monosp:`none`, a perfect mirror)

 * - eta, k
   - |spectrum| or |texture|
   - Real and imaginary part of the index of refraction, from 0 to 1000, instead of
     :monosp:`material`. (Default: 0 and 1, if only the other one is given)
   - |exposed|, |differentiable|, |discontinuous|

 * - int_ior, ext_ior
   - |float| or |string|
   - Indices of refraction inside and outside of a dielectric, from 0.001 to 1000, or names such as
     :monosp:`bk7`, instead of a metal. Only the reflection is modelled; transmitted light is
     absorbed. (Default: :monosp:`bk7` and :monosp:`air`, if only the other one is given)

 * - specular_reflectance
   - |spectrum| or |texture|
   - Factor on the reflection, in [0, 1]. (Default: 1)
   - |exposed|, |differentiable|

:mod:`glintbsdf.bridge.registration` imports these modules again in each JIT variant.
"""
