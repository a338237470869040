"""Power law: the flow rate increases with the stress and decreases with relaxation."""

from hmsa.model.flows.record import Flow, FlowConstant

FLOW = Flow(
    'power_law', 1, '(x/tau) |x/s|^(m - 1)',
    'J. S. Bergstroem, M. C. Boyce, J. Mech. Phys. Solids 46, 931 (1998), '
    'doi:10.1016/S0022-5096(97)00075-6, without its dependence on strain',
    (FlowConstant(
        'exponent',
        'exponent m of the power law with which a branch flows, 1 for a Maxwell branch',
        1.0, 20.0),
     FlowConstant(
         'stress', 'stress s, in units of the shear modulus, at which a branch that flows by a '
         'power law relaxes with its relaxation time', 1e-3, 10.0)),
    lambda exponent, stress: stress ** (1.0 - exponent))
