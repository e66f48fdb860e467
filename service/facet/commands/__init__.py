"""The commands of `facet`, one module each; `facet.__main__` puts them together."""
