"""What a crystal is drawn from: scenarios, and the draw of one episode from its random streams."""
