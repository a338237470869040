"""The services by which parameters are read and set, made to survive any request."""

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter_service import ParameterService


class CarefulParameterService(ParameterService):
    """
    The parameter services of rclpy, which refuse what they cannot read.

    Those of rclpy raise an error on a value whose type does not exist, and with it end the
    node: anybody in the domain could end it with one message. Make the node with
    ``start_parameter_services=False`` and one of these after that.
    """

    def _set_parameters_callback(
            self, request: SetParameters.Request,
            response: SetParameters.Response) -> SetParameters.Response:
        change = super()._set_parameters_callback
        response.results = []
        for parameter in request.parameters:
            # One at a time: what cannot be read is no reason to refuse the others.
            try:
                one = change(
                    SetParameters.Request(parameters=[parameter]), SetParameters.Response())
                response.results.append(one.results[0])
            except Exception as error:  # rclpy raises errors of several unrelated classes here
                response.results.append(_refused(error))
        return response

    def _set_parameters_atomically_callback(
            self, request: SetParametersAtomically.Request,
            response: SetParametersAtomically.Response) -> SetParametersAtomically.Response:
        try:
            return super()._set_parameters_atomically_callback(request, response)
        except Exception as error:  # as above
            response.result = _refused(error)
            return response


def _refused(error: Exception) -> SetParametersResult:
    return SetParametersResult(
        successful=False, reason=f'{error}: expected a declared parameter of its own type')
