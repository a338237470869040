# Completion of hmsa for fish: ~/.config/fish/completions/hmsa.fish
function __hmsa_at
  set -l at ''
  for word in (commandline -opc)[2..-1]
    if test "$word" = --ros-args
      set at --ros-args
      break
    end
    set -l next (string trim -- "$at $word")
    if contains -- "$next" {{ paths|join(' ') }}
      set at $next
    end
  end
  test "$at" = "$argv[1]"
end
complete -c hmsa -f
{% for command in commands %}
{% set begin = 'complete -c hmsa -n ' ~ ('__hmsa_at "' ~ command.path ~ '"')|quote %}
{% for word, text in command.words.items() %}
{{ begin }} -a {{ word }} -d {{ text|quote }}
{% endfor %}
{% if command.files %}
{{ begin }} -F
{% endif %}
{% for option in command.options %}
{{ begin }}{% for x in option.names %}{{ ' -l ' ~ x[2:] if x.startswith('--') else ' -s ' ~ x[1:] }}{% endfor %}{{ {'': '', 'any': ' -x', 'file': ' -r -F', 'folder': " -x -a '(__fish_complete_directories)'", 'one': ' -x -a ' ~ option.choices|join(' ')|quote}[option.value] }} -d {{ option.text|quote }}
{% endfor %}
{% endfor %}
complete -c hmsa -n '__hmsa_at "--ros-args"' -a -p -d 'set a parameter, NAME:=VALUE'
complete -c hmsa -n '__hmsa_at "--ros-args"' -a -r -d 'remap a name, FROM:=TO'
complete -c hmsa -n '__hmsa_at "--ros-args"' -a --params-file -d 'file with parameters' -F
complete -c hmsa -n '__hmsa_at "--ros-args"' -a --log-level -d 'lowest severity to log'
complete -c hmsa -n '__hmsa_at "--ros-args"' -a --enclave -d 'security enclave'
complete -c hmsa -n '__hmsa_at "--ros-args"' -a --disable-rosout-logs -d 'do not publish the log'
