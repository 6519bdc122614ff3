"""Images as arrays of pixels: files, colour spaces, sizes, metrics."""
