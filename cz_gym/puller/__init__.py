"""The machine: puller files, identification from logs, export to a controller, the virtual puller."""
