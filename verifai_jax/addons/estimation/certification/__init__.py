"""Certificates of safety for many policies at once."""

from verifai_jax.addons.estimation.certification._certify import certify as certify
from verifai_jax.addons.estimation.certification.allocation import race as race
from verifai_jax.addons.estimation.certification.certification import Certification as Certification
from verifai_jax.addons.estimation.certification.result import Certificate as Certificate
from verifai_jax.addons.estimation.certification.result import Certificates as Certificates
