"""Where messages come from: Zenoh (live) and MCAP (recording). A source gives envelopes."""
