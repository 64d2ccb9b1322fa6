"""PID controllers: the paper's, filtered, re-tuned and conventional ones, the industrial law, and no control at all."""
