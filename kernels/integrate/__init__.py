"""Update of the TSDF from one frame."""
