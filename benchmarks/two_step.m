% The two-step command (Eq. 13) by the recipe of the paper: ode45 to the turning point, fzero on
% the load. Called as
%
%     octave-cli two_step.m TOLERANCE REPEATS < moves
%
% with lines "start target zeta j_lim c1". Prints beta_p and tau_p of each move, and last the
% minimum and median time per plan in nanoseconds.
1;

function load = holding_load (l, j_lim)
  load = (l - l ^ -2) / (1 - (2 / l + l ^ 2 - 3) / j_lim);
end

function dy = motion (y, load, zeta, j_lim, c1)
  l = y(1);
  v = y(2);
  left = 1 - (2 / l + l ^ 2 - 3) / j_lim;
  dy = [v; (1.5 * v ^ 2 / l - 3 * zeta * c1 * l ^ 3 * v ...
            - 6 * ((l ^ 4 - l) / left - load * l ^ 3)) / (1 + c1 * l ^ 3)];
end

function [value, terminal, direction] = turning (t, y, side)
  value = y(2);
  terminal = 1;
  direction = -side;
end

function [miss, t] = turning_point (load, move, tolerance)
  side = sign (move(2) - move(1));
  slope = @(t, y) motion (y, load, move(3), move(4), move(5));
  options = odeset ('RelTol', tolerance, 'AbsTol', tolerance, 'Refine', 1);
  events = odeset (options, 'Events', @(t, y) turning (t, y, side));
  % The event must not catch the rest at the start.
  [t, y] = ode45 (slope, [0 20], [move(1); side * 1e-300], events);
  % Events are interpolated linearly: repeat from the step before, then refine by Newton.
  [t, y] = ode45 (slope, t(end-1:end), y(end - 1, :)', options);
  dy = slope (t(end), y(end, :)');
  left = -dy(1) / dy(2);
  t = t(end) + left;
  miss = y(end, 1) + 0.5 * left * dy(1) - move(2);
end

% ode45 warns at every event, which takes time.
warning ('off', 'all');
words = argv ();
tolerance = str2double (words{end - 1});
repeats = str2double (words{end});
moves = reshape (fscanf (stdin, '%f'), 5, [])';
times = zeros (repeats, 1);
for n = 1:repeats
  tic;
  for m = 1:rows (moves)
    move = moves(m, :);
    low = holding_load (move(1), move(4));
    high = holding_load (move(2), move(4));
    load_p(m) = fzero (@(load) turning_point (load, move, tolerance), ...
                       [low + 0.01 * (high - low), high], optimset ('TolX', tolerance));
    [miss, time_p(m)] = turning_point (load_p(m), move, tolerance);
  end
  times(n) = toc / rows (moves);
end
printf ('%.17g %.17g\n', [load_p; time_p]);
printf ('%.1f %.1f\n', 1e9 * min (times), 1e9 * median (times));
