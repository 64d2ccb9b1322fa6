"""A virtual puller: the environment behind an OPC UA server, with an operator's page:
``cz-gym serve``."""
