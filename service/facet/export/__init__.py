"""The model in other programs' formats: `formats.FORMATS`. Nothing here changes a map."""
