"""How questions are answered: trials beside samplers that are trained for them."""
