"""Drawing: pictures and animations of a tracked garment, and diagrams."""
