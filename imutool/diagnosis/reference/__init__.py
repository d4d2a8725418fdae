"""References: own poses, and simulations in other units or of another motion."""
