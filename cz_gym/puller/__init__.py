"""The machine's numbers: puller files, and the pullers that ship."""
