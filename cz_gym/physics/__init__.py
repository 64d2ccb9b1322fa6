"""The plant: parameters, meniscus, bright ring, rates of change, operating point, linearisation."""
