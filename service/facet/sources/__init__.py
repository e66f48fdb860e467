"""Where messages come from: Zenoh (live) and MCAP (recording). A source is an iterable of envelopes."""
