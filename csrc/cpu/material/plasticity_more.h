// The CPU loop of return_mapping over tables with laws of core/material/more_laws.h.
#pragma once

#include "core/material/args.h"

namespace gsf {

template <typename T>
bool any_compiled_apart(const ReturnMappingArgs<T>& a);
template <typename T>
void return_mapping_more(const ReturnMappingArgs<T>& a);

}  // namespace gsf
