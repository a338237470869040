# Completion of hmsa for bash: eval "$(hmsa completion bash)"
_hmsa_words() {
  local each
  while IFS= read -r each; do COMPREPLY+=("$each"); done \
    < <(compgen -W "$*" -- "$cur")
}
_hmsa_files() {
  local each
  compopt -o filenames 2> /dev/null
  while IFS= read -r each; do COMPREPLY+=("$each"); done < <(compgen "$1" -- "$cur")
}
_hmsa() {
  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD-1]}
  local at='' word i
  COMPREPLY=()
  for ((i = 1; i < COMP_CWORD; i++)); do
    word=${COMP_WORDS[i]}
    if [[ $word == --ros-args ]]; then at='--ros-args'; break; fi
    case "${at:+$at }$word" in
      @paths@) at="${at:+$at }$word" ;;
    esac
  done
  case "$at:$prev" in
@values@
    '--ros-args:--params-file') _hmsa_files -f; return ;;
    --ros-args:-[pr] | '--ros-args:--log-level') return ;;
  esac
  case "$at" in
@words@
    '--ros-args') _hmsa_words -p -r --params-file --log-level --enclave --disable-rosout-logs ;;
  esac
}
complete -F _hmsa hmsa
