"""Laws for what no effect of the catalogue explains: which states the residual follows, a sparse law, its file."""
