# SPDX-License-Identifier: Apache-2.0
"""A managed node whose transitions may fail but never end the process."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
import traceback
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.simulated_time import TimedNode
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode, TimedNode):
    """
    A managed node (ROS 2 lifecycle) that says why a transition failed.

    A transition fails if `configure`, `activate` or `deactivate` of a subclass raises. All
    publishers, subscriptions, services and timers that were made since `configure` began are
    destroyed by the transition cleanup, and if `configure` fails.

    Attributes
    ----------
    state : str
        unconfigured, inactive, active or finalized.

    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.state = 'unconfigured'
        self._error: Exception | None = None
        self._lasting: set[Any] = set()
        # In rclpy 7.1 a transition that the state does not allow raises, and ends the spinning.
        service = next(s for s in self.services if s.service_name.endswith('/change_state'))
        service.callback = self._guarded(service.callback)

    def destroy_node(self) -> None:
        """
        Destroy the node, and its state machine, which rclpy 7.1 leaves.

        It would keep the node, and all that the middleware has for it, until the process ends;
        there Fast DDS may wait for ever.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    @abstractmethod
    def configure(self) -> None:
        """Make what the node needs; raise if it is not possible."""

    @abstractmethod
    def activate(self) -> None:
        """Begin to work."""

    @abstractmethod
    def deactivate(self) -> None:
        """Stop working; also called when the node is not active."""

    def cleanup(self) -> None:
        """Stop working and destroy what was made since `configure` began, all or part of it."""
        self.deactivate()
        for entity, destroy in list(self._entities()):
            if entity not in self._lasting:
                destroy(entity)

    def start(self) -> None:
        """
        Configure and activate at once.

        Raises
        ------
        Exception
            What `configure` or `activate` raised.

        """
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != SUCCESS:
                assert self._error is not None
                raise self._error

    def stop(self) -> None:
        """Finalize from whatever state."""
        if self.state != 'finalized':
            self.trigger_shutdown()

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Unconfigured to inactive."""
        self._lasting = {entity for entity, _ in self._entities()}
        return self._attempt(self.configure, 'inactive', undo=self.cleanup)

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to active."""
        return self._attempt(self.activate, 'active', undo=self.deactivate)

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Active to inactive."""
        return self._attempt(self.deactivate, 'inactive')

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to unconfigured."""
        return self._attempt(self.cleanup, 'unconfigured')

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Any state to finalized."""
        return self._attempt(
            self.deactivate if self.state == 'unconfigured' else self.cleanup, 'finalized'
        )

    def _attempt(
        self, action: Callable[[], None], goal: str, undo: Callable[[], None] | None = None
    ) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            self._error = error
            if undo is not None:
                undo()
            return FAILURE
        self.state = goal
        return SUCCESS

    def _entities(self) -> Iterator[tuple[Any, Callable[[Any], object]]]:
        """Yield what the node has in ROS, each with what destroys it."""
        clock = self.resolve_topic_name('/clock')  # rclpy's own, also made later
        others = [s for s in self.subscriptions if s.topic_name != clock]
        for entities, destroy in (
            (self.publishers, self.destroy_publisher),
            (others, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.timers, self.destroy_timer),
        ):
            yield from ((entity, destroy) for entity in entities)

    def _guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        def change_state(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            self._error = None
            before, wanted = self.state, request.transition.label or request.transition.id
            try:
                response = callback(request, response)
            except RuntimeError:  # rcl's
                response.success = False
            if response.success:
                self.get_logger().info(f'{before} -> {self.state}')
            elif self._error is None:
                self.get_logger().warning(f'transition {wanted} is not possible while {before}')
            elif isinstance(self._error, ConfigurationError):
                self.get_logger().error(f'transition {wanted} failed: {self._error}')
            else:
                text = ''.join(traceback.format_exception(self._error))
                self.get_logger().error(f'transition {wanted} failed: {text}')
            return response

        return change_state
