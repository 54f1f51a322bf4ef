"""Recordings of other programs: messages of any type to samples, samples of many clocks to rows."""
