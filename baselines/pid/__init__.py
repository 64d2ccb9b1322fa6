"""PID controllers: the paper's, filtered, re-tuned and conventional ones."""
