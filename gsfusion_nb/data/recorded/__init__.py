"""A recording on disk as a sequence, and what its readers share: finding files, decoding images,
poses, times."""
