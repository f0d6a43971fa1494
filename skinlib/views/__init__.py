"""Everything a notebook shows; no other room imports matplotlib, pyvista, ipywidgets.

`picture` holds the image that every function here returns, `plots` draws numbers,
`scenes` draws heads and `widgets` puts sliders on both.
"""

from skinlib.views.picture import Picture, picture_grid

__all__ = ["Picture", "picture_grid"]
