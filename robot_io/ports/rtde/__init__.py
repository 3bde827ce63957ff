"""Universal Robots' Real-Time Data Exchange: registers over TCP."""
