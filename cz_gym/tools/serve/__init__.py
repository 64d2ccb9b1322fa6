"""A virtual puller: the environment behind an OPC UA server, with a page: ``cz-gym serve``."""
