"""Parts as triangle meshes, in millimetres."""
