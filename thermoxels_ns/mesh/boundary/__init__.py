"""The boundary of a mesh: tags, patches, normals, areas and visibility."""
