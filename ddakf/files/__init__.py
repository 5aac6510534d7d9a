"""File formats: meshes, clouds, depth images, sequences, and the user's cache folder."""
