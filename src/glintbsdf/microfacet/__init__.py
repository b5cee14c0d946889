"""The microfacet frame around a distribution of normals."""
